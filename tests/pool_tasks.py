"""A pool of processes whose tasks do what their items say. A module of its own, which the processes import."""

from __future__ import annotations

import logging
import os
import signal
import struct
import time
from functools import partial
from logging.handlers import QueueHandler
from pathlib import Path

from ufmstar_torch.eval.suite.shards import run_pool


def pool(folder, items, stop=lambda: False):
    """Do all items by two processes: (all were done, the lines that were reported)."""
    lines: list[str] = []
    return run_pool(partial(task, str(folder)), items, 2, 1, stop=stop, report=lines.append), lines


def task(folder, item):
    """Writes a file ITEM-PROCESS; then ends the process where the item is "kill" or "half", fails, waits or warns."""
    Path(folder, f"{item}-{os.getpid()}").touch()
    if item == "kill":
        os.kill(os.getpid(), signal.SIGKILL)
    if item == "half":  # a record is begun, and never ended
        (handler,) = (h for h in logging.getLogger("ufmstar_torch").handlers if isinstance(h, QueueHandler))
        os.write(handler.queue._writer.fileno(), struct.pack("!i", 1000) + b"half")
        os.kill(os.getpid(), signal.SIGKILL)
    while item.startswith("wait"):
        time.sleep(0.02)
    if item.startswith("warn"):
        logging.getLogger("ufmstar_torch").warning("stream %s: hardly a segment matches", item[4:])
    if item == "fail":
        raise OSError("disk full")
    return f"{item} done"
