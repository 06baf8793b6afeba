"""How the page looks, and the little that it does."""

from __future__ import annotations

STYLE = """
:root {
  --paper: #fbfaf8; --card: #ffffff; --ink: #1d1d1f; --faint: #62646a; --line: #dedbd5; --accent: #0b6aa2;
  --good: #1b7a4b; --bad: #b3372c; --even: #7a6a2f; --stripe: #f4f2ee; --shade: rgba(0, 0, 0, .06);
  color-scheme: light dark;
}
@media (prefers-color-scheme: dark) {
  :root {
    --paper: #17181b; --card: #1f2125; --ink: #e8e6e1; --faint: #a2a4aa; --line: #383b41; --accent: #6cb8ea;
    --good: #67c795; --bad: #f08b80; --even: #d3bd6c; --stripe: #24262b; --shade: rgba(0, 0, 0, .4);
  }
}
* { box-sizing: border-box; }
html { scroll-behavior: smooth; -webkit-text-size-adjust: 100%; }
body {
  margin: 0; background: var(--paper); color: var(--ink);
  font: 16px/1.55 system-ui, -apple-system, "Segoe UI", Roboto, "Helvetica Neue", "Liberation Sans", sans-serif;
}
.frame { display: grid; grid-template-columns: 13.5rem minmax(0, 1fr); gap: 0 2rem;
  grid-template-areas: "nav head" "nav main"; grid-template-rows: auto 1fr; max-width: 88rem; margin: 0 auto;
  padding: 0 1.5rem; }
header { grid-area: head; padding-top: 2rem; min-width: 0; }
nav { grid-area: nav; position: sticky; top: 0; align-self: start; max-height: 100vh; overflow: auto; padding: 2.2rem 0;
  font-size: .9rem; }
nav h2 { font-size: .78rem; letter-spacing: .06em; text-transform: uppercase; color: var(--faint); margin: 0 0 .5rem;
  border: 0; padding: 0; }
nav ol { list-style: none; margin: 0; padding: 0; }
nav a { display: block; padding: .22rem 0 .22rem .7rem; color: var(--ink); text-decoration: none;
  border-left: 2px solid var(--line); }
nav a:hover, nav a:focus-visible { border-color: var(--accent); color: var(--accent); }
main { grid-area: main; padding: 0 0 4rem; min-width: 0; }
h1 { font-size: clamp(1.6rem, 4.5vw, 2.3rem); line-height: 1.18; margin: 0 0 .4rem; text-wrap: balance; }
h2 { font-size: 1.4rem; line-height: 1.25; margin: 3.2rem 0 .8rem; padding-top: .9rem;
  border-top: 1px solid var(--line); }
main > section:first-child h2 { margin-top: 1rem; }
h3 { font-size: 1.06rem; margin: 1.8rem 0 .5rem; }
p, li, dd { max-width: 46rem; overflow-wrap: anywhere; }
a { color: var(--accent); }
code { font: .88em ui-monospace, "SF Mono", Menlo, Consolas, "Liberation Mono", monospace; overflow-wrap: anywhere; }
.lead { color: var(--faint); margin: 0 0 1rem; }
.facts { display: flex; flex-wrap: wrap; gap: .5rem; margin: 0 0 1.5rem; padding: 0; list-style: none; }
.facts li { background: var(--card); border: 1px solid var(--line); border-radius: .5rem; padding: .35rem .75rem; }
.facts b { font-size: 1.15rem; font-variant-numeric: tabular-nums; margin-right: .3rem; }
.findings { padding-left: 1.2rem; }
.findings li { margin: .5rem 0; }
.caveats { border-left: 3px solid var(--even); background: var(--card); padding: .6rem 1rem .6rem 2rem;
  border-radius: 0 .4rem .4rem 0; }
.verdict { font-weight: 600; white-space: nowrap; }
.better { color: var(--good); } .worse { color: var(--bad); } .open, .single { color: var(--even); }
table.board td { border-left: 1px solid var(--line); }
.board .verdict, .beside { display: block; }
.beside { color: var(--faint); font-size: .88em; }
.table { margin: 1rem 0 1.6rem; }
.scroll { overflow-x: auto; background: var(--card); border: 1px solid var(--line); border-radius: .5rem; }
.scroll:focus-visible, summary:focus-visible, .zoom:focus-visible { outline: 2px solid var(--accent);
  outline-offset: 2px; }
table { border-collapse: collapse; font-size: .87rem; width: 100%; }
caption { text-align: left; font-weight: 600; padding: .6rem .55rem; position: sticky; left: 0; }
th, td { padding: .3rem .55rem; text-align: left; vertical-align: baseline; white-space: nowrap; }
td.words { white-space: normal; overflow-wrap: anywhere; min-width: 7rem; max-width: 40rem; }
th.number, td.number { text-align: right; font-variant-numeric: tabular-nums; }
thead th { border-bottom: 1px solid var(--line); font-weight: 600; color: var(--faint); vertical-align: bottom; }
thead th.group { text-align: center; color: var(--ink); }
tbody th { font-weight: 400; position: sticky; left: 0; background: var(--card); box-shadow: 1px 0 0 var(--line); }
tbody tr:nth-child(even) td, tbody tr:nth-child(even) th { background: var(--stripe); }
tbody + tbody tr:first-child > * { border-top: 1px solid var(--line); }
th[aria-sort], th.sortable { cursor: pointer; }
th[aria-sort="ascending"]::after { content: " ▲"; font-size: .7em; }
th[aria-sort="descending"]::after { content: " ▼"; font-size: .7em; }
.half, .none { color: var(--faint); font-size: .88em; }
.notes { font-size: .85rem; color: var(--faint); margin: .5rem 0 0; padding-left: 1.2rem; }
figure { margin: 1.2rem 0 1.8rem; }
figure .scroll { padding: .5rem; background: #fff; }
figure img { display: block; max-width: 100%; height: auto; margin: 0 auto; }
figcaption { margin-top: .5rem; font-size: .9rem; color: var(--faint); max-width: 46rem; }
figcaption b { color: var(--ink); }
details { margin: .6rem 0; border: 1px solid var(--line); border-radius: .5rem; padding: 0 1rem;
  background: var(--card); }
summary { cursor: pointer; padding: .55rem 0; font-weight: 600; }
dl { display: grid; grid-template-columns: minmax(7rem, max-content) minmax(0, 1fr); gap: .4rem 1.2rem; }
dt { font-weight: 600; } dd { margin: 0; }
dl dl { font-size: .92em; margin: 0; }
.zoom { cursor: zoom-in; }
dialog { border: 0; padding: .5rem; max-width: 98vw; max-height: 96vh; overflow: auto; background: #fff;
  border-radius: .4rem; }
dialog::backdrop { background: rgba(0, 0, 0, .75); }
dialog img { display: block; max-width: none; cursor: zoom-out; }
footer { border-top: 1px solid var(--line); margin-top: 3rem; padding-top: 1rem; color: var(--faint);
  font-size: .88rem; }
@media (max-width: 62rem) {
  .frame { grid-template-columns: minmax(0, 1fr); grid-template-areas: "head" "nav" "main"; padding: 0 1rem; }
  header { padding-top: 1.2rem; }
  nav { position: static; max-height: none; padding: 0; }
  nav ol { columns: 9.5rem; column-gap: 1rem; }
  nav li { break-inside: avoid; }
}
@media (max-width: 34rem) {
  /* A strip of five pictures is not readable at the width of a phone: it scrolls. */
  figure .scroll img { max-width: none; width: max(100%, 44rem); }
  th, td { padding: .3rem .5rem; }
  tbody th { white-space: normal; min-width: 7.7rem; max-width: 9.5rem; overflow-wrap: anywhere; }
  dl { grid-template-columns: 1fr; gap: .1rem; } dd { margin-bottom: .6rem; }
}
@media print {
  :root { --paper: #fff; --card: #fff; --ink: #000; --faint: #444; --line: #bbb; --stripe: #f6f6f6; --accent: #000;
    --good: #0a5a34; --bad: #8c1f16; --even: #5c4e1c; color-scheme: light; }
  body { font-size: 10pt; }
  nav, dialog { display: none; }
  .frame { display: block; max-width: none; padding: 0; }
  .scroll { overflow: visible; border: 0; }
  table { font-size: 7.5pt; } th, td { padding: .15rem .35rem; white-space: normal; }
  h2, h3, caption { break-after: avoid; } figure, tr { break-inside: avoid; }
}
"""

# The page is whole without it. Sorting is over all blocks; a third press brings the order back.
SCRIPT = """
(() => {
  const value = (row, column) => {
    const text = row.cells[column] ? row.cells[column].textContent.trim().replace(/\\u2212/g, "-") : "";
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
      large.style.width = 1.5 * picture.getAttribute("width") + "px";
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
"""
