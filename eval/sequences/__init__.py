"""Dataset readers: posed frames from common layouts, or from any images and poses."""

from __future__ import annotations

from typing import TYPE_CHECKING

from ufmstar_torch.runtime.optional import lazy_names

if TYPE_CHECKING:
    from ufmstar_torch.eval.sequences.depth_folder import depth_maps as depth_maps
    from ufmstar_torch.eval.sequences.frame import Frame as Frame
    from ufmstar_torch.eval.sequences.frame import FrameError as FrameError
    from ufmstar_torch.eval.sequences.frame import FrameSequence as FrameSequence
    from ufmstar_torch.eval.sequences.frame import Skipped as Skipped
    from ufmstar_torch.eval.sequences.layout import Found as Found
    from ufmstar_torch.eval.sequences.layout import find_sequences as find_sequences
    from ufmstar_torch.eval.sequences.open import open_sequence as open_sequence
    from ufmstar_torch.eval.sequences.poses import read_trajectory as read_trajectory
    from ufmstar_torch.gaussians.conventions import CONVENTIONS as CONVENTIONS
    from ufmstar_torch.gaussians.trajectory import Trajectory as Trajectory
    from ufmstar_torch.gaussians.trajectory import interpolate_pose as interpolate_pose
else:
    __getattr__, __dir__ = lazy_names(__name__)
