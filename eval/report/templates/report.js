// The page is whole without it: tables sort (a third press restores the order), pictures enlarge.
(() => {
  const value = (row, column) => {
    const text = row.cells[column] ? row.cells[column].textContent.trim().replace(/\u2212/g, "-") : "";
    const found = parseFloat(text.replace("<", ""));
    return Number.isNaN(found) ? text : found;
  };
  for (const table of document.querySelectorAll("table")) {
    const heads = [...table.tHead.rows[table.tHead.rows.length - 1].cells];
    const bodies = [...table.tBodies], home = bodies.map((body) => [...body.rows]);
    if (home.flat().length < 3) continue;
    heads.forEach((head, column) => {
      head.classList.add("sortable");
      head.tabIndex = 0;
      const sort = () => {
        const next = { none: "ascending", ascending: "descending", descending: "none" }[head.ariaSort || "none"];
        heads.forEach((other) => other.removeAttribute("aria-sort"));
        bodies.forEach((body, i) => body.append(...home[i]));
        if (next === "none") return;
        head.setAttribute("aria-sort", next);
        const sign = next === "ascending" ? 1 : -1;
        bodies[0].append(...home.flat().sort((a, b) => {
          const x = value(a, column), y = value(b, column);
          if (typeof x !== typeof y) return typeof x === "number" ? -1 : 1;
          return sign * (typeof x === "number" ? x - y : x.localeCompare(y));
        }));
      };
      head.addEventListener("click", sort);
      head.addEventListener("keydown", (event) => { if (event.key === "Enter") sort(); });
    });
  }
  const dialog = document.createElement("dialog");
  dialog.setAttribute("aria-label", "picture, enlarged");
  document.body.append(dialog);
  dialog.addEventListener("click", () => dialog.close());
  for (const picture of document.querySelectorAll("img.zoom")) {
    picture.tabIndex = 0;
    const show = () => {
      const large = picture.cloneNode();
      large.classList.remove("zoom");
      large.style.width = 1.5 * picture.naturalWidth + "px";
      large.style.height = "auto";
      dialog.replaceChildren(large);
      dialog.showModal();
    };
    picture.addEventListener("click", show);
    picture.addEventListener("keydown", (event) => { if (event.key === "Enter") show(); });
  }
  window.addEventListener("beforeprint", () => document.querySelectorAll("details").forEach((d) => { d.open = true;
  }));
})();
