"""The networks behind the rows: chosen by a user as ``BASE=MODEL:FILE[,FILE...]``, loaded, and run one by one."""

from __future__ import annotations

import hashlib
import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch

from ufmstar_torch.eval.engine.network_checks import check_members, without_sampling
from ufmstar_torch.eval.engine.network_label import label_of
from ufmstar_torch.eval.engine.predicted import Predicted, together
from ufmstar_torch.eval.engine.predictor import MemberPredictor, Predictor, TruthPredictor
from ufmstar_torch.eval.engine.run_source import load_members, require_same_input, sha256
from ufmstar_torch.eval.methods.method import BASES
from ufmstar_torch.eval.sequences.frame import Frame, Size, parse_size
from ufmstar_torch.models.dropout import SAMPLES
from ufmstar_torch.models.load import network_names
from ufmstar_torch.models.network import DepthNetwork

TRUTH = "ground-truth"
_FORM = "BASE=MODEL:FILE[,FILE...]"
_VERSION = 2  # of the digests: raise it where predictions from the same files change


@dataclass(frozen=True)
class NetworkChoice:
    """A network for a base, as chosen by a user.

    Attributes:
        base: a key of ``method.BASES``.
        model: a name that ``load_network`` knows, or "ground-truth" (of "depth_only": the sequence's own depth, which
            shows what a method says of perfect depth).
        files: its weights, one or several files, in the order of the members. Of "trained", "FILE#2" is member 2 of
            the file alone. A file .json is the spec that goes with the weights. Of "ground-truth" nothing, or "HxW".
        label: as shown; "" = told from the files.

    Raises:
        ValueError: no such base or model, no files, or files that do not go together.
    """

    base: str
    model: str
    files: tuple[str, ...] = ()
    label: str = ""

    def __post_init__(self) -> None:
        if self.base not in BASES:
            raise ValueError(f"base must be one of {', '.join(BASES)}, got {self.base!r}; expected {_FORM}")
        if self.model == TRUTH:
            if self.base != "depth_only" or len(self.files) > 1:
                raise ValueError("ground-truth goes with depth_only, as in depth_only=ground-truth[:HxW]")
            try:
                parse_size(self.files[0] if self.files else None)
            except ValueError as error:
                raise ValueError(f"ground-truth:HxW needs a size in pixels, got {self.files[0]!r}") from error
            return
        if self.model not in network_names():
            known = ", ".join((*network_names(), TRUTH))
            raise ValueError(f"model must be one of {known}, got {self.model!r}; expected {_FORM}")
        if not self.weights:
            raise ValueError(f"{self.base}={self.model} needs the file of its weights: {_FORM}")
        if len([file for file in self.files if _is_spec(file)]) > 1:
            raise ValueError(f"{self.base}={self.model} takes one spec, got {self.files}")

    @classmethod
    def parse(cls, text: str, label: str = "") -> NetworkChoice:
        """From ``BASE=MODEL:FILE[,FILE...]``.

        Raises:
            ValueError: another form.
        """
        base, equals, rest = text.partition("=")
        model, _, files = rest.partition(":")
        if not (base and equals and model):
            raise ValueError(f"a network must be given as {_FORM}, got {text!r}")
        return cls(base, model, tuple(file for file in files.split(",") if file), label)

    @property
    def weights(self) -> tuple[str, ...]:
        """The files without the spec."""
        return tuple(file for file in self.files if not _is_spec(file))

    @property
    def spec(self) -> str | None:
        """The file that declares what the weights do not say."""
        return next((file for file in self.files if _is_spec(file)), None)

    @property
    def size(self) -> Size | None:
        """(h, w) to which ground truth is brought; None = as it is."""
        return parse_size(self.files[0]) if self.model == TRUTH and self.files else None


class BaseNetwork:
    """The loaded network(s) of a base.

    An ensemble's or BatchEnsemble's members take turns: image i is member i mod N's. MC-Dropout draws one sample an
    image, or ``samples`` of them. Its sample n of frame i is seeded by i and n, so that it is the same whatever ran
    before, on one process or many; the first one is what ``ufmstar run`` draws.

    Args:
        choice: which.
        device: where they run.
        samples: MC-Dropout's, on every image where a row asks for all.

    Attributes:
        base: as in ``choice``.
        label: as shown, "FastDepth".
        digest: tells these networks from others in a cache.
        identity: plain values for the record of what was run.
        networks: the members as they are run, on ``device``; none of ground truth.
        passes: inferences that "all" takes.
        needs_image: whether it predicts from the image; from the depth map otherwise.

    Raises:
        FileNotFoundError: a file is missing.
        ValueError: files that do not fit, or a network that does not say what its base is about; see
            ``check_members``.
    """

    def __init__(self, choice: NetworkChoice, device: torch.device, *, samples: int = SAMPLES) -> None:
        self.choice, self.base = choice, choice.base
        self._predictor: Predictor
        self.networks: tuple[DepthNetwork, ...] = ()
        if choice.model == TRUTH:
            self.needs_image, self._members, self.passes = False, 1, 1
            self._predictor = TruthPredictor(choice.size)
            self.label = choice.label or "ground truth"
            self.identity: dict[str, Any] = {"model": TRUTH, "label": self.label, "size": choice.size}
            self.digest = _digest(self.identity)
            return
        members = _load(choice)
        sampling = self.base == "mc_dropout"
        check_members(self.base, members, device)
        self.needs_image, self._members, self.networks = True, len(members), tuple(members)
        self.passes = samples if sampling else len(members)
        self._predictor = MemberPredictor(members, device, sampling=sampling)
        files = [_identity(file) for file in choice.weights]
        spec = None if choice.spec is None else sha256(Path(choice.spec))
        made_of = {"model": choice.model, "files": [file | {"name": None} for file in files], "spec": spec}
        drawn = {"samples": samples} if sampling else {}
        self.digest = _digest({**made_of, **drawn, "device": device.type, "version": _VERSION})
        self.label = choice.label or label_of(choice.model, Path(_path(choice.weights[0])[0]), members[0])
        self.identity = {
            "model": choice.model, "label": self.label, "files": files, "spec": spec, "members": len(members), **drawn,
        }  # fmt: skip

    @property
    def cacheable(self) -> bool:
        """Whether keeping its predictions saves anything."""
        return self.needs_image

    def turn(self, position: int) -> int:
        """Whose turn it is on the image that a row uses after ``position`` others."""
        return position % self._members

    def one(self, frame: Frame, n: int) -> Predicted:
        """What member (or sample) n says, from one inference.

        Raises:
            FrameError: the frame has nothing to predict from.
        """
        return self._predictor.one(frame, n)

    def predict(self, frame: Frame, position: int, every_member: bool) -> Predicted:
        """What a row gets: all members (or samples) put together, or the one whose turn it is.

        Raises:
            FrameError: the frame has nothing to predict from.
        """
        if every_member:
            return together([self.one(frame, n) for n in range(self.passes)])
        return self.one(frame, self.turn(position))


def _load(choice: NetworkChoice) -> list[DepthNetwork]:
    """The members that the files hold, in their order."""
    try:
        members: list[DepthNetwork] = []
        for file in choice.weights:
            path, member = _path(file)
            found = load_members(choice.model, [path], spec=choice.spec)
            if member is not None and member >= len(found):
                raise ValueError(f"{path} has {len(found)} members, there is no {member} (counted from 0)")
            members += found if member is None else [found[member]]
        require_same_input(members)
    except ValueError as error:
        raise ValueError(f"{choice.base}={choice.model}: {error}") from error
    return members if choice.base == "mc_dropout" else [without_sampling(member) for member in members]


def _path(file: str) -> tuple[str, int | None]:
    """A file and the member of it that is meant; None = all of them."""
    path, mark, number = file.rpartition("#")
    if mark and path and number.isdecimal() and not Path(file).exists():
        return path, int(number)
    return file, None


def _identity(file: str) -> dict[str, Any]:
    path, member = _path(file)
    return {"name": Path(path).name, "sha256": sha256(Path(path)), "member": member}


def _is_spec(file: str) -> bool:
    return file.endswith(".json")


def _digest(values: dict[str, Any]) -> str:
    return hashlib.sha256(json.dumps(values, sort_keys=True).encode()).hexdigest()
