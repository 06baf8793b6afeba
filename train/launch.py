"""Several processes that train together: the first prepares the folder, the others wait until it has.

A launcher (torchrun, SLURM, one command per computer) starts processes in any order, and their process group exists
only once Lightning trains. Until then they communicate through the store of torch.distributed's rendezvous. It belongs
to this launch, so that no message of an earlier launch is read.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import AbstractContextManager, ExitStack, contextmanager
from datetime import timedelta
from pathlib import Path
from typing import cast

import lightning.pytorch as pl
import torch.distributed as dist
from lightning.pytorch.strategies import ParallelStrategy

from ufmstar_torch.eval.run.folder import FolderError

# Longer than the processes of a launch are apart, also where machines are handed out one after another.
WAIT_SECONDS = 600.0
_READY = "ready"


@contextmanager
def prepared_by_first(
    prepare: AbstractContextManager[None], trainer: pl.Trainer, out: Path, *, wait: float = WAIT_SECONDS
) -> Iterator[None]:
    """Within this, the first process is within ``prepare``, which it alone enters, and the others are after its
    beginning, for which they wait at most ``wait`` [s]. ``trainer`` has this process's rank, the number of processes
    and their address; messages name the folder ``out``. Raises FolderError: the first process could not prepare the
    folder, or the others have waited in vain; OSError: from ``prepare``."""
    first = trainer.is_global_zero
    # The first process holds the store up to the end: it serves the others.
    try:
        store = _meet(trainer, wait) if trainer.world_size > 1 else None
        key = "" if store is None else _key(store, trainer.global_rank)
        if store is not None and not first:
            store.wait([key], timedelta(seconds=wait))
    except dist.DistError as error:
        raise FolderError(
            f"--out {out}: process {trainer.global_rank} of {trainer.world_size} has waited {wait:g} s for the first "
            f"process to prepare it ({str(error).splitlines()[0]}); was it started, and with the same MASTER_ADDR and "
            "MASTER_PORT?"
        ) from error
    with ExitStack() as held:
        if first:
            message = "the first process was interrupted"
            try:
                held.enter_context(prepare)
                message = _READY
            except (OSError, ValueError) as error:
                message = str(error)
                raise
            finally:
                if store is not None:
                    store.set(key, message)
        elif store is not None and (message := store.get(key).decode()) != _READY:
            raise FolderError(f"the first process could not prepare the folder: {message}")
        elif not out.is_dir():
            raise FolderError(f"--out {out} does not exist: all machines must see the folder of the first process")
        yield


def _meet(trainer: pl.Trainer, wait: float) -> dist.TCPStore:
    """The store where process group and this meet: torchrun's own, or else one that the first process opens."""
    environment = cast(ParallelStrategy, trainer.strategy).cluster_environment
    if environment is None:
        raise ValueError(f"{type(trainer.strategy).__name__} does not state the address of its processes")
    # A port that Lightning has chosen for this launch: what it starts later, and its process group, take the same.
    os.environ.setdefault("MASTER_PORT", str(environment.main_port))
    served = os.environ.get("TORCHELASTIC_USE_AGENT_STORE") == str(True)
    return dist.TCPStore(
        environment.main_address,
        environment.main_port,
        None,
        trainer.is_global_zero and not served,
        timedelta(seconds=wait),
        wait_for_workers=False,
        multi_tenant=not served,
    )


def _key(store: dist.Store, rank: int) -> str:
    """The key of the first process's message: a new one for every restart by torchrun, and every training."""
    attempt = f"ufmstar/{os.environ.get('TORCHELASTIC_RESTART_COUNT', '0')}"
    return f"{attempt}/prepared/{store.add(f'{attempt}/trainings/{rank}', 1)}"
