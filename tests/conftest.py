"""What several test files share: one evaluation with its report."""

from __future__ import annotations

from pathlib import Path

import pytest


@pytest.fixture(scope="session")
def evaluation(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """An evaluation with a failed, an unfinished and a hostile sequence, example frames and a room, and its report."""
    from evaluations import ENSEMBLE, HOSTILE, KITCHEN, LATER, SCENES, TITLE, write_evaluation, write_examples

    from ufmstar_torch.eval.report.write import write_report

    out = tmp_path_factory.mktemp("evaluation") / "out"
    failed = {("tum", "fr1_xyz"): HOSTILE}
    write_evaluation(out, ENSEMBLE, [*SCENES, KITCHEN], title=TITLE, unfinished=[LATER], failed=failed)
    write_examples(out, *KITCHEN, ENSEMBLE)
    assert write_report(out).undrawn == {}
    return out
