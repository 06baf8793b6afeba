"""Depth networks: each is an ``nn.Module`` that takes an image and returns a ``DepthPrediction`` in metres.

Each name below imports its module at its first use, not when this package is imported.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from ufmstar_torch.runtime.optional import lazy_names

if TYPE_CHECKING:
    from ufmstar_torch.models.alignment import AlignedNetwork as AlignedNetwork
    from ufmstar_torch.models.alignment import Alignment as Alignment
    from ufmstar_torch.models.alignment import AlignmentFit as AlignmentFit
    from ufmstar_torch.models.alignment import fit_affine_depth as fit_affine_depth
    from ufmstar_torch.models.alignment import fit_inverse_depth as fit_inverse_depth
    from ufmstar_torch.models.any_network import WrappedNetwork as WrappedNetwork
    from ufmstar_torch.models.any_network import wrap_network as wrap_network
    from ufmstar_torch.models.batch_ensemble import BatchEnsemble as BatchEnsemble
    from ufmstar_torch.models.batch_ensemble import convert as convert
    from ufmstar_torch.models.checkpoints import CheckpointError as CheckpointError
    from ufmstar_torch.models.checkpoints import load_state_dict_file as load_state_dict_file
    from ufmstar_torch.models.checkpoints import save_checkpoint as save_checkpoint
    from ufmstar_torch.models.depth_anything import DepthAnything as DepthAnything
    from ufmstar_torch.models.distribution import EvidentialDepth as EvidentialDepth
    from ufmstar_torch.models.distribution import GaussianDepth as GaussianDepth
    from ufmstar_torch.models.distribution import PointDepth as PointDepth
    from ufmstar_torch.models.dropout import DecoderDropout as DecoderDropout
    from ufmstar_torch.models.dropout import MonteCarloDropout as MonteCarloDropout
    from ufmstar_torch.models.dropout import set_sampling as set_sampling
    from ufmstar_torch.models.ensemble import Ensemble as Ensemble
    from ufmstar_torch.models.ensemble import LazyMember as LazyMember
    from ufmstar_torch.models.fastdepth import FastDepth as FastDepth
    from ufmstar_torch.models.fastdepth import FastDepthWidths as FastDepthWidths
    from ufmstar_torch.models.heads import AleatoricHead as AleatoricHead
    from ufmstar_torch.models.heads import EvidentialHead as EvidentialHead
    from ufmstar_torch.models.heads import UncertaintyNetwork as UncertaintyNetwork
    from ufmstar_torch.models.heads import with_head as with_head
    from ufmstar_torch.models.hugging_face import HuggingFaceDepth as HuggingFaceDepth
    from ufmstar_torch.models.hugging_face import from_hugging_face as from_hugging_face
    from ufmstar_torch.models.load import load_network as load_network
    from ufmstar_torch.models.module_backbone import ModuleBackbone as ModuleBackbone
    from ufmstar_torch.models.module_backbone import ModuleSpec as ModuleSpec
    from ufmstar_torch.models.monodepth2 import MonodepthResNet as MonodepthResNet
    from ufmstar_torch.models.monodepth2_import import load_monodepth2 as load_monodepth2
    from ufmstar_torch.models.network import Backbone as Backbone
    from ufmstar_torch.models.network import DepthNetwork as DepthNetwork
    from ufmstar_torch.models.onnx_network import OnnxNetwork as OnnxNetwork
    from ufmstar_torch.models.onnx_network import OnnxSpec as OnnxSpec
    from ufmstar_torch.models.outputs import OutputSpec as OutputSpec
    from ufmstar_torch.models.preprocess import Preprocess as Preprocess
    from ufmstar_torch.models.spec import NetworkSpec as NetworkSpec
    from ufmstar_torch.models.spec import build_backbone as build_backbone
    from ufmstar_torch.models.spec import build_network as build_network
    from ufmstar_torch.models.trained import TrainedInfo as TrainedInfo
    from ufmstar_torch.models.trained import load_trained as load_trained
    from ufmstar_torch.models.trained import read_info as read_info
    from ufmstar_torch.models.trained import save_trained as save_trained
else:
    __getattr__, __dir__ = lazy_names(__name__)
