"""The structure of the package: import order of layers, packages and folders, a lightweight bare import."""

from __future__ import annotations

import ast
import re
import subprocess
import sys
import tomllib
from functools import cache
from graphlib import TopologicalSorter
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
LAYERS = {"core": 0, "models": 1, "eval": 2, "train": 3}
HEAVY = ("torch", "lightning", "torchvision", "kornia", "matplotlib", "torchmetrics", "scipy", "cv2", "onnxruntime")
HEAVY += ("numba",)
PYPROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["setuptools"]
REFERENCE = ("steps", "gaussians", "frames")


def layer_of(path: Path) -> str:
    top = path.relative_to(ROOT).parts[0]
    return "core" if top == "ufmstar_torch" else top


def sources() -> list[Path]:
    return [p for top in ("ufmstar_torch", "models", "eval", "train") for p in sorted((ROOT / top).rglob("*.py"))]


@cache
def tree(path: Path) -> ast.Module:
    return ast.parse(path.read_text())


@cache
def imported(path: Path) -> list[tuple[str, list[str]]]:
    """(module, names) of every import statement, at any depth."""
    result: list[tuple[str, list[str]]] = []
    for node in ast.walk(tree(path)):
        if isinstance(node, ast.Import):
            result += [(alias.name, []) for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}: relative imports hide which layer is meant"
            result.append((node.module or "", [alias.name for alias in node.names]))
    return result


def target_layer(module: str, names: list[str]) -> str | None:
    parts = module.split(".")
    if parts[0] != "ufmstar_torch":
        return None
    candidates = parts[1:2] or names
    return next((c for c in candidates if c in LAYERS), "core")


def test_layers_import_leftward_only():
    wrong = []
    for path in sources():
        if path.name == "cli.py":
            continue  # the command line imports everything
        rank = LAYERS[layer_of(path)]
        for module, names in imported(path):
            layer = target_layer(module, names)
            if layer is not None and LAYERS[layer] > rank:
                wrong.append(f"{path} (layer {layer_of(path)}) imports {module}")
            if module == "ufmstar_torch.cli" or (module == "ufmstar_torch" and "cli" in names):
                wrong.append(f"{path} imports the roof")
    assert not wrong


# Imports inside eval/ are ordered too: a package may import from its line and the lines above.
EVAL_ORDER = (
    ("sequences", "metrics"),
    ("tour", "methods", "check"),
    ("engine",),
    ("run",),
    ("suite",),
    ("bench", "reconstruct", "report"),
    ("commands",),
)


def test_imports_inside_eval_go_one_way():
    rank = {name: number for number, names in enumerate(EVAL_ORDER) for name in names}
    result = set()
    for path in sorted((ROOT / "eval").rglob("*.py")):
        importer = path.relative_to(ROOT / "eval").with_suffix("").parts
        if importer == ("__init__",):
            continue
        for module, names in imported(path):
            parts = module.split(".")
            if parts[:2] != ["ufmstar_torch", "eval"]:
                continue
            for target in [parts[2]] if len(parts) > 2 else names:
                if rank[target] > rank[importer[0]] or (rank[target] == rank[importer[0]] and target != importer[0]):
                    result.add(f"{'.'.join(importer)} -> {'.'.join(parts[2:]) or target}")
    assert not result, result


def test_no_modules_import_each_other_in_a_circle():
    """Includes imports inside functions."""
    names = {module_of(path): path for path in sources() if path.name != "__init__.py"}

    def targets(path: Path) -> set[str]:
        each = [(module, name) for module, imports in imported(path) for name in imports or [""]]
        return {full if (full := f"{module}.{name}") in names else module for module, name in each} & names.keys()

    graph = {name: targets(path) - {name} for name, path in names.items()}
    TopologicalSorter(graph).prepare()  # a CycleError names the circle


def module_of(path: Path) -> str:
    parts = path.relative_to(ROOT).with_suffix("").parts
    return ".".join(parts if parts[0] == "ufmstar_torch" else ("ufmstar_torch", *parts))


def test_no_slow_tier_imports_a_fast_one():
    for path in sources():
        if path.parent.parent == ROOT / "ufmstar_torch" and path.parent.name in REFERENCE and path.stem != "extensions":
            assert not any("kernels" in module for module, _ in imported(path)), path


def test_kernels_import_back_only_plain_types():
    plain = {
        "GaussianMixture",
        "Regression",
        "regress",
        "distribute",
        "random_order",
        "Correspondence",
        "PIXEL_VARIANCE",
        "UfMStarConfig",
        "SPGFConfig",
        "Triangulated",
        "DAMPING",
        "STEPS",
        "FrameInput",
        "HALF",
        "DEPTH_RANGE",
        "FARTHEST",
        "FOCAL_RANGE",
        "LARGEST",
        "POLAR_STEPS",
        "COMPLETE",
        "LEAST",
        "SampleStatistics",
        "inverse_intrinsics",
    }
    core = ROOT / "ufmstar_torch"
    for path in (*(core / "kernels" / "cpu").glob("*.py"), *(core / "anchors" / "kernels").glob("*.py")):
        if path.stem in ("step", "learn", "neighbours"):
            continue  # calls the kernels; all else is the reference's code
        for module, names in imported(path):
            if module.startswith("ufmstar_torch.") and "kernels" not in module:
                allowed = {n for n in names if n in plain}
                assert set(names) == allowed, f"{path} imports {names} from {module}"


def test_folders_on_disk_are_the_packages():
    on_disk = set()
    for top in ("ufmstar_torch", "models", "eval", "train"):
        for init in (ROOT / top).rglob("__init__.py"):
            dotted = ".".join(init.parent.relative_to(ROOT).parts)
            on_disk.add(dotted if top == "ufmstar_torch" else f"ufmstar_torch.{dotted}")
        for folder in (ROOT / top).rglob("*"):
            if folder.is_dir() and any(folder.glob("*.py")):
                assert (folder / "__init__.py").exists(), f"{folder} would vanish from the wheel"
    assert set(PYPROJECT["packages"]) == on_disk
    mapping = {"ufmstar_torch": "ufmstar_torch"} | {f"ufmstar_torch.{x}": x for x in ("models", "eval", "train")}
    assert PYPROJECT["package-dir"] == mapping


def test_data_files_beside_the_modules_are_packaged():
    folders = {name: ROOT / name.removeprefix("ufmstar_torch.").replace(".", "/") for name in PYPROJECT["package-data"]}
    globs = PYPROJECT["package-data"].items()
    listed = {path for name, patterns in globs for pattern in patterns for path in folders[name].glob(pattern)}
    data = {p for p in (ROOT / "eval").rglob("*") if p.is_file() and p.suffix != ".py" and "__pycache__" not in p.parts}
    assert data - listed == set()


@pytest.mark.parametrize("module", ["ufmstar_torch", *(f"ufmstar_torch.{x}" for x in ("models", "eval", "train"))])
def test_a_bare_import_is_light(module):
    code = f"import sys, {module}; print([m for m in {HEAVY!r} if m in sys.modules])"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


def test_generic_names_are_not_importable(tmp_path):
    code = "from importlib.util import find_spec; print([find_spec(x) for x in ('models', 'eval', 'train')])"
    done = subprocess.run([sys.executable, "-P", "-c", code], capture_output=True, text=True, check=True, cwd=tmp_path)
    assert done.stdout.strip() == "[None, None, None]"


def test_oracles_import_numpy_and_each_other_alone():
    oracles = sorted((ROOT / "tests").glob("oracle*.py"))
    allowed = {"numpy", *sys.stdlib_module_names, *(path.stem for path in oracles)}
    for path in oracles:
        assert {module.partition(".")[0] for module, _ in imported(path)} <= allowed, path


def test_every_module_has_a_docstring():
    for path in sources():
        assert ast.get_docstring(tree(path)) or path.read_text() == "", path


def test_the_module_and_the_step_are_read_at_once():
    for name, most in (("ufmstar.py", 350), ("steps/step.py", 300)):
        assert len((ROOT / "ufmstar_torch" / name).read_text().splitlines()) < most, name


def test_names_are_nouns_of_what_they_hold():
    """Participles and pronouns say nothing of a value."""
    vague = {"given", "kept", "own", "place", "known", "beside", "taken", "said", "look", "alike"}
    found = []
    for path in sources():
        for node in ast.walk(tree(path)):
            name = {ast.arg: "arg", ast.FunctionDef: "name", ast.Name: "id"}.get(type(node), "")
            if getattr(node, name, "").strip("_") in vague:
                found.append(f"{path.relative_to(ROOT)}:{node.lineno}")
    assert found == []


def test_no_utility_modules_no_blanket_excepts():
    for path in sources():
        assert path.stem not in ("utils", "helpers", "common", "misc"), path
        for node in ast.walk(tree(path)):
            if isinstance(node, ast.ExceptHandler):
                names = ast.unparse(node.type) if node.type else ""
                assert names, f"{path}:{node.lineno} bare except"
                blanket = re.search(r"\b(Base)?Exception\b", names)
                reraises = any(isinstance(n, ast.Raise) and n.exc is None for n in ast.walk(node))
                assert not blanket or reraises, f"{path}:{node.lineno} catches everything"
