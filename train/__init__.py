"""Training of the networks: losses, augmentation, data, and the loop around them.

Each name below imports its module at its first use, not when this package is imported.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from ufmstar_torch.runtime.optional import lazy_names

if TYPE_CHECKING:
    from ufmstar_torch.train.augment import Augmentation as Augmentation
    from ufmstar_torch.train.augment import AugmentationConfig as AugmentationConfig
    from ufmstar_torch.train.data import DepthDataModule as DepthDataModule
    from ufmstar_torch.train.data_config import DataConfig as DataConfig
    from ufmstar_torch.train.losses import loss_of as loss_of
    from ufmstar_torch.train.losses import loss_sums as loss_sums
    from ufmstar_torch.train.member import ResumeError as ResumeError
    from ufmstar_torch.train.module import NonFiniteLossError as NonFiniteLossError
    from ufmstar_torch.train.module import TrainingModule as TrainingModule
    from ufmstar_torch.train.nyu import convert_labelled as convert_labelled
    from ufmstar_torch.train.own_network import own_job as own_job
    from ufmstar_torch.train.own_network import train_module as train_module
    from ufmstar_torch.train.presets import PRESETS as PRESETS
    from ufmstar_torch.train.presets import Recipe as Recipe
    from ufmstar_torch.train.presets import preset as preset
    from ufmstar_torch.train.samples import SampleDataset as SampleDataset
    from ufmstar_torch.train.sequence_data import SequenceFrames as SequenceFrames
    from ufmstar_torch.train.settings import FitSettings as FitSettings
    from ufmstar_torch.train.settings import Job as Job
    from ufmstar_torch.train.start import starting_network as starting_network
    from ufmstar_torch.train.tour_data import tour_frames as tour_frames
    from ufmstar_torch.train.uncertainty import UncertaintyCallback as UncertaintyCallback
    from ufmstar_torch.train.uncertainty import judge_network as judge_network
else:
    __getattr__, __dir__ = lazy_names(__name__)
