"""Several processes on this computer that share an evaluation."""

from __future__ import annotations

import secrets
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Mapping
from typing import Any

from ufmstar_torch.eval.results.machine import available_cores
from ufmstar_torch.eval.results.worker import DONE, STOPPED, Share, as_json

_POLL_SECONDS = 0.05
_PATIENCE_SECONDS = 10.0  # for a process that was told to end at once
_COMMAND = (sys.executable, "-P", "-m", "ufmstar_torch.eval.results.worker")


def run_pool(
    options: Mapping[str, Any], *, stop: Callable[[], bool], tell: Callable[[str], None], command: Any = _COMMAND
) -> bool:
    """Start the processes and wait for all of them.

    One that ends early takes only the sequence in hand with it: the others do the rest.

    Args:
        options: of ``ufmstar eval``; the output folder is prepared.
        stop: True: all are told to end after the frame in hand.
        tell: gets a line for each process that ends early.
        command: that runs ``worker.main``.

    Returns:
        Whether every process came to its end.
    """
    count, launch = options["processes"], secrets.token_hex(8)
    threads = options["threads"] or max(1, available_cores() // count)
    shares = [Share(options, n + 1, count, n, launch, threads) for n in range(count)]
    children: list[subprocess.Popen[str]] = []
    try:
        for share in shares:
            # In a session of its own, so that Ctrl-C reaches this process alone, which passes it on.
            child = subprocess.Popen(command, stdin=subprocess.PIPE, text=True, start_new_session=True)
            children.append(child)
            assert child.stdin is not None
            child.stdin.write(as_json(share))
            child.stdin.close()
        return _wait(children, shares, stop, tell)
    finally:
        _end(children)


def _wait(
    children: list[subprocess.Popen[str]], shares: list[Share], stop: Callable[[], bool], tell: Callable[[str], None]
) -> bool:
    running = dict(zip(children, shares, strict=True))
    told, well = False, True
    while running:
        if not told and stop():
            told = True
            for child in running:
                child.send_signal(signal.SIGTERM)
        for child in [child for child in running if child.poll() is not None]:
            share = running.pop(child)
            well = well and child.returncode == DONE
            if child.returncode not in (DONE, STOPPED):
                how = f"signal {-child.returncode}" if child.returncode < 0 else f"code {child.returncode}"
                tell(f"process {share.label} ended early ({how})")
        time.sleep(_POLL_SECONDS)
    return well


def _end(children: list[subprocess.Popen[str]]) -> None:
    """End those that still run, now."""
    for child in children:
        if child.poll() is None:
            child.kill()
    for child in children:
        child.wait(_PATIENCE_SECONDS)
