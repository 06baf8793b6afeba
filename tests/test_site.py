"""The site, the workflows, and the files by which others find, cite and report: they agree with the package."""

from __future__ import annotations

import importlib
import re
import tomllib
from pathlib import Path, PurePosixPath
from typing import Any

import pytest
import yaml

import ufmstar_torch

ROOT = Path(__file__).resolve().parents[1]
DOCS = ROOT / "docs"
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
WORKFLOWS = sorted((ROOT / ".github" / "workflows").glob("*.yml"))
PACKAGES = re.findall(r"<!-- reference (\S+) -->", "".join(p.read_text() for p in (DOCS / "reference").glob("*.md")))


@pytest.fixture
def pages(monkeypatch: pytest.MonkeyPatch) -> Any:
    monkeypatch.syspath_prepend(str(DOCS))
    return importlib.import_module("site_pages")


# ---- pages ----


def test_every_page_is_in_the_navigation() -> None:
    def named(part: Any) -> list[str]:
        if isinstance(part, str):
            return [part]
        return [name for item in (part.values() if isinstance(part, dict) else part) for name in named(item)]

    nav = named(yaml.safe_load((ROOT / "mkdocs.yml").read_text())["nav"])
    assert sorted(nav) == sorted(p.relative_to(DOCS).as_posix() for p in DOCS.rglob("*.md"))


def test_the_first_page_shows_a_picture_first_and_then_readme(pages: Any) -> None:
    source = (DOCS / "index.md").read_text()
    assert [line[:2] for line in source.splitlines() if line] == ["# ", "![", "<!"]
    page = type("Page", (), {"file": type("File", (), {"src_uri": "index.md"})})
    text = pages.on_page_markdown(source, page=page)
    assert text.index("![") < text.index("How far can a robot trust") < text.index("## First run")
    assert text.count("fr1_xyz.jpg") == 1
    assert "(data.md)" in text  # was docs/data.md
    assert "(docs/" not in text


def test_links_out_of_docs_become_names(pages: Any) -> None:
    text = "[a](../examples/tsdf.py) [`tsdf.py`](../examples/tsdf.py) [b](data.md#x) [c](#d) [e](../README.md#speed)\n"
    text += "```python\n[a](../examples/tsdf.py)\n```\n"
    expected = "a (`examples/tsdf.py`) `tsdf.py` [b](data.md#x) [c](#d) [e](index.md#speed)\n"
    assert pages.in_site(text, PurePosixPath("docs")) == expected + "```python\n[a](../examples/tsdf.py)\n```\n"
    deeper = pages.in_site("[b](../data.md) ![p](../images/p.jpg)", PurePosixPath("docs/results"))
    assert deeper == "[b](../data.md) ![p](../images/p.jpg)"


@pytest.mark.parametrize("package", PACKAGES)
def test_the_reference_has_every_public_name(pages: Any, package: str) -> None:
    names = [name.rpartition(".")[2] for name in pages.public_names(package)]
    public = importlib.import_module(package)
    assert sorted(names) == sorted(getattr(public, "__all__", None) or dir(public))
    assert len(names) > 3


def test_docstrings_keep_their_brackets(pages: Any) -> None:
    pytest.importorskip("griffe", reason="needs the extra docs")
    text = importlib.import_module("site_docstrings").as_markdown(
        "depth [B, H, W] [m], see :func:`f` and ``a[0]*b``: UfM*"
    )
    assert text == r"depth \[B, H, W\] \[m\], see `f` and ``a[0]*b``: UfM\*"


# ---- workflows and what GitHub reads ----


@pytest.mark.parametrize("path", WORKFLOWS, ids=lambda path: path.stem)
def test_a_workflow_has_jobs_with_steps_that_exist(path: Path) -> None:
    workflow = yaml.safe_load(path.read_text())
    assert {"name", True, "jobs", "permissions"} <= workflow.keys()  # YAML reads the key "on" as True
    assert workflow["permissions"] == {"contents": "read"}
    targets = re.findall(r"^([a-z-]+):", (ROOT / "Makefile").read_text(), re.MULTILINE)
    for job in workflow["jobs"].values():
        assert job["runs-on"]
        assert set([job["needs"]] if "needs" in job else []) <= workflow["jobs"].keys()
        for step in job["steps"]:
            assert ("uses" in step) != ("run" in step)
            assert re.fullmatch(r"[\w-]+/[\w-]+@[\w./]+", step.get("uses", "a/b@v1"))
            for line in re.findall(r"\bmake ([a-z ]+)", step.get("run", "")):
                assert set(line.split()) <= set(targets)


def test_tests_run_on_every_system_and_declared_python() -> None:
    workflow = yaml.safe_load((ROOT / ".github" / "workflows" / "tests.yml").read_text())
    matrix = workflow["jobs"]["tests"]["strategy"]["matrix"]
    declared = [c.rpartition(" ")[2] for c in PROJECT["classifiers"] if re.search(r":: 3\.\d+$", c)]
    assert matrix["python"] == declared
    assert PROJECT["requires-python"] == f">={declared[0]}"
    systems = " ".join(matrix["system"])
    assert all(name in systems for name in ("ubuntu", "-arm", "macos", "windows"))


def test_a_release_stores_no_token() -> None:
    text = (ROOT / ".github" / "workflows" / "release.yml").read_text()
    assert "id-token: write" in text
    assert "secrets." not in text


def test_version_and_licence_are_the_same_everywhere() -> None:
    citation = yaml.safe_load((ROOT / "CITATION.cff").read_text())
    assert citation["version"] == PROJECT["version"] == ufmstar_torch.__version__
    assert citation["license"] == PROJECT["license"]
    assert {"title", "authors", "message"} <= citation.keys()
    assert citation["preferred-citation"]["title"].startswith("UfM*: Uncertainty from Motion*")


def test_issue_forms_ask_for_the_block_of_versions(ufmstar: Any) -> None:
    forms = [p for p in (ROOT / ".github" / "ISSUE_TEMPLATE").glob("*.yml") if p.stem != "config"]
    assert len(forms) == 2
    for form in forms:
        fields = yaml.safe_load(form.read_text())["body"]
        asked = next(field["attributes"] for field in fields if field["id"] == "system")
        assert "ufmstar --version --system" in asked["description"]
    code, out, _ = ufmstar("--version", "--system")
    assert code == 0
    block = dict(line.split(maxsplit=1) for line in out.splitlines())
    assert block["ufmstar_torch"] == ufmstar_torch.__version__
    assert {"torch", "numba", "numpy", "python", "system", "processor", "memory", "GPU"} <= block.keys()
    assert str(Path.home()) not in out


def test_constraints_pin_the_tools_of_the_site() -> None:
    pinned = {
        line.split("==")[0].lower() for line in (ROOT / "constraints.txt").read_text().splitlines() if "==" in line
    }
    for group in ("docs", "test"):
        for requirement in PROJECT["optional-dependencies"][group]:
            name = re.split(r"[\[>=]", requirement)[0].lower()
            assert {name, name.replace("-", "_")} & pinned, requirement
