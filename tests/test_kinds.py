"""Arguments of a wrong kind: every public function of the networks' and outer layers names the argument."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Mapping, Sequence
from importlib import import_module
from pathlib import Path
from typing import Any, Literal, TypeVar

import numpy as np
import pytest
import torch
from torch import Tensor, nn

from ufmstar_torch.models import EvidentialDepth, GaussianDepth
from ufmstar_torch.runtime.kinds import check_kinds, require

Module = TypeVar("Module", bound=nn.Module)
MAP = torch.ones(1, 4, 5)
FITTING = [
    (int, 3, np.int64(3)), (float, 1, 1.5, np.float64(1), float("nan")), (bool, True, np.bool_(False)),
    (str | None, "a", None), (Path, Path("a")), (str | Path, "a", Path("a")), (Tensor, MAP, MAP[0].bfloat16()),
    (np.ndarray[Any, np.dtype[np.float64]], np.zeros(2)), (Callable[[int], int], len), (type[nn.Module], nn.Conv2d),
    (tuple[int, int], (1, 2), [1, np.int32(2)], torch.Size((1, 2)), np.array([1, 2])),
    (tuple[float, ...], (), (1, 2.5)), (Sequence[float], [1.0], np.array([0.1]), torch.tensor([0.1])),
    (Sequence[str], ("a",)), (Mapping[str, Any], {}), (Literal["a", "b"], "c"), (Any, object()), (object, object()),
    (Module, nn.Identity()),
]  # fmt: skip
WRONG = [
    (int, 1.5, True, "1", np.float64(1), np.zeros(1), MAP, None), (float, True, "1", None, 1j, MAP, np.zeros(2)),
    (bool, 1, "yes", None), (str | None, 1, b"a"), (Path, "a", b"a"), (str | Path, b"a", 1),
    (Tensor, np.zeros(2), [1.0], None, MAP.to_sparse()), (np.ndarray[Any, np.dtype[np.float64]], MAP, [1.0]),
    (Callable[[int], int], 3, "len"), (type[nn.Module], nn.Identity()),
    (tuple[int, int], 1, (1,), (1, 2.5), "ab", np.zeros(2), np.array([1, 2, 3]), np.zeros((2, 2), int)),
    (tuple[float, ...], 1.0, ("a",), None), (Sequence[float], "1", 1.0, torch.tensor(1.0), np.array(["a"])),
    (Sequence[str], "a", [1]), (Mapping[str, Any], [], "a"), (Literal["a", "b"], 1), (Module, object(), "a"),
]  # fmt: skip


@pytest.mark.parametrize(("hint", "values"), [pytest.param(hint, values, id=str(hint)) for hint, *values in FITTING])
def test_a_value_of_the_kind_passes(hint, values):
    for value in values:
        require("x", value, hint)


@pytest.mark.parametrize(("hint", "values"), [pytest.param(hint, values, id=str(hint)) for hint, *values in WRONG])
def test_a_value_of_another_kind_is_named(hint, values):
    for value in values:
        with pytest.raises(TypeError, match=f"^x must be .*, got {type(value).__name__}"):
            require("x", value, hint)


def test_a_call_that_lacks_an_argument_raises_the_functions_own_error():
    @check_kinds
    def scaled(depth: Tensor, by: float = 1.0, **_options: int) -> Tensor:
        return depth * by

    assert scaled(MAP, by=2).equal(2 * MAP)
    with pytest.raises(TypeError, match=r"scaled\(\) missing 1 required positional argument: 'depth'"):
        scaled()
    with pytest.raises(TypeError, match=r"depth must be a dense torch\.Tensor, got list of float"):
        scaled([1.0])


# Functions that check their own arguments, with the same result.
OWN = {
    "wrap_network",
    "interpolate_pose",
    "landmark_source",
    "make_movers",
    "make_tour",
    "read_trajectory",
    "with_head",
}


def public_functions():
    for package in ("models", "eval.sequences", "eval.metrics", "eval.tour", "anchors", "train"):
        module = import_module(f"ufmstar_torch.{package}")
        for name in dir(module):
            value = getattr(module, name)
            if inspect.isfunction(value) and name not in OWN:
                yield pytest.param(value, id=name)


@pytest.mark.parametrize("function", [*public_functions()])
def test_every_public_function_names_an_argument_of_another_kind(function):
    arguments = {
        name: object()
        for name, parameter in inspect.signature(function).parameters.items()
        if parameter.default is parameter.empty and parameter.kind is not parameter.VAR_KEYWORD
    }
    with pytest.raises(TypeError, match=rf"({'|'.join(arguments)}) must be .*, got object"):
        function(**arguments)


@pytest.mark.parametrize(
    "make",
    [lambda: GaussianDepth(MAP, MAP[:, 1:]), lambda: EvidentialDepth(MAP, MAP, MAP, None)],
    ids=["shape", "kind"],
)
def test_parameters_of_a_distribution_are_maps_of_one_shape(make):
    with pytest.raises(ValueError, match=r"GaussianDepth must hold maps of one shape|EvidentialDepth.beta must be a"):
        make()
