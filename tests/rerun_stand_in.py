"""A stand-in for the package rerun: it records calls to the module and to its streams."""

from __future__ import annotations

import sys
from types import ModuleType
from typing import NamedTuple

import pytest


class Rerun(ModuleType):
    """Records calls as (name, positional arguments, keyword arguments)."""

    def __init__(self):
        super().__init__("rerun")
        self.calls = []

    def __getattr__(self, name):
        if name in ("ViewCoordinates", "components", "FillMode", "Radius", "__spec__", "__path__"):
            return self
        return lambda *words, **named: self.calls.append((name, words, named)) or Made(name, words, named)

    def logged(self, entity):
        return [words[1] for name, words, _ in self.calls if name == "log" and words[0] == entity]


class Made(NamedTuple):
    name: str
    words: tuple
    named: dict

    def compress(self, jpeg_quality):
        return self

    def log(self, *words, **named):
        STAND_IN.calls.append(("log", words, named))

    def save(self, path, **_):
        path.write_bytes(b"rrd")

    def set_time(self, *words, **named):
        STAND_IN.calls.append(("set_time", words, named))

    def flush(self):
        pass

    def connect_grpc(self, *words, **named):
        STAND_IN.calls.append(("connect_grpc", words, named))

    def __enter__(self):
        return self

    def __exit__(self, *_):
        pass


STAND_IN = Rerun()


@pytest.fixture
def stand_in(monkeypatch):
    STAND_IN.calls.clear()
    for name in ("rerun", "rerun.blueprint"):
        monkeypatch.setitem(sys.modules, name, STAND_IN)
    return STAND_IN
