"""Several sequences through the loop at once: the results of each are those that it has alone."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from runs import Brightness, networks
from suite_runs import NAMES, go, job_on, kept, write_rooms
from tiny_suite import CPU, base_network, evaluate_all, in_memory, row, same, write_network

from ufmstar_torch import UfMStarConfig
from ufmstar_torch.eval.engine.estimators import Gaussians
from ufmstar_torch.eval.engine.evaluate import Judge, SequenceTask, evaluate_sequences
from ufmstar_torch.eval.engine.maps import own_depth
from ufmstar_torch.eval.engine.rows import RowRunner
from ufmstar_torch.eval.engine.stream import FrameSink, FrameStream, Stopped, drive_together
from ufmstar_torch.eval.results.eval_folder import EvalFolder
from ufmstar_torch.eval.sequences import FrameError
from ufmstar_torch.eval.tour.sequence import open_tour
from ufmstar_torch.models import Preprocess
from ufmstar_torch.state import UfMStarState

LENGTHS = (4, 2, 3, 2)
ROWS = [
    row("Ensemble"),
    row("UfM-Ensemble"),
    row("UfM*-Ensemble"),
    row("UfM*-FullEnsemble"),
    row("UfM*-Ensemble", skip=1, translation_noise=0.01),
    row("UfM*-Ensemble", anchors="tracked", posterior=True),
    row("UfM*-Ensemble", anchors="truth", corrected=True),
]


class Watched(Brightness):
    """Notes the sizes of its batches."""

    def __init__(self, *args, **options):
        super().__init__(*args, **options)
        self.sizes = []

    def forward(self, image):
        self.sizes.append(len(image))
        return super().forward(image)


@pytest.fixture(scope="module")
def tours():
    """Rendered frames in memory, sequences of different lengths: parts of one walk."""
    walk = open_tour(f"tour:5?frames={sum(LENGTHS)}&size=72x96")
    starts = [sum(LENGTHS[:n]) for n in range(len(LENGTHS))]
    parts = [in_memory(walk, slice(start, start + m)) for start, m in zip(starts, LENGTHS, strict=True)]
    return [replace(part, name=f"tour {n}") for n, part in enumerate(parts)]


def ensemble():
    members = [Watched(1 + 0.2 * n, spread=0.02) for n in range(2)]
    return {"ensemble": networks(*members, preprocess=Preprocess(size=(72, 96)))}, members


@pytest.fixture(scope="module")
def alone(tours):
    return evaluate_all(tours, ROWS, ensemble()[0])


def broken_at(sequence, index, error):
    """The sequence with an image whose decoding raises."""

    def load():
        raise error

    entries = list(sequence.entries)
    entries[index] = replace(entries[index], load_image=load)
    return replace(sequence, entries=tuple(entries))


@pytest.mark.parametrize("streams", [3, *(pytest.param(n, marks=pytest.mark.slow) for n in (2, 8))])
def test_every_row_of_every_sequence_has_the_bits_that_it_has_alone(tours, alone, streams):
    bases, members = ensemble()
    together = evaluate_all(tours, ROWS, bases, streams=streams)
    for one, other in zip(alone, together, strict=True):
        assert [result.row for result in other] == ROWS
        assert all(same(a, b) for a, b in zip(one, other, strict=True))
    assert max(max(member.sizes) for member in members) == min(streams, len(tours))
    assert sum(sum(member.sizes) for member in members) == 2 * sum(LENGTHS), "each member sees each image once"


def test_the_state_has_the_bits_of_a_sequence_alone(tours):
    """After every frame; a stream that becomes free begins again, another one waits for the end of its sequence."""

    def states(streams):
        first = Gaussians(UfMStarConfig(on_bad_frame="skip"), CPU, streams=streams)
        seen = {n: [] for n in range(len(tours))}

        class States(FrameSink):
            def __init__(self, number):
                self.number = number

            def begin(self, stream):
                self.stream = stream

            def take(self, result):
                seen[self.number].append(self.stream.state()["row"])

        free = list(range(streams))

        def entries():
            for n, sequence in enumerate(tours):
                runner = RowRunner("row", own_depth((24, 32)), first.stream(free.pop()))
                stream = FrameStream(sequence, range(LENGTHS[n]), [runner])
                stream.slot = runner.estimator._stream
                yield stream, [States(n)]

        for stream, error in drive_together(entries(), at_once=streams):
            assert error is None
            free.append(stream.slot)
        return seen

    one, three = states(1), states(3)
    for n, length in enumerate(LENGTHS):
        assert len(three[n]) == length
        for expected, actual in zip(one[n], three[n], strict=True):
            assert actual.keys() == expected.keys()
            used = int((expected["ufm.weight"] > 0).sum())
            assert used
            for name in UfMStarState.names():
                a, b = (state[f"ufm.{name}"] for state in (expected, actual))
                slots = name in ("mean", "covariance", "weight", "disagreement", "count", "features")
                assert torch.equal(*((a[:, :used], b[:, :used]) if slots else (a.nan_to_num(-1), b.nan_to_num(-1))))


@pytest.mark.slow
def test_maps_of_other_sizes_are_another_batch(tours):
    small = in_memory(open_tour("tour:9?frames=3&size=48x64"), slice(None))
    sequences, rows = [tours[0], small, tours[1], small], [row("UfM*-DepthOnly"), row("DepthOnly")]
    bases = {"depth_only": own_depth()}
    alone = evaluate_all(sequences, rows, bases)
    together = evaluate_all(sequences, rows, bases, streams=3)
    assert all(same(a, b) for one, other in zip(alone, together, strict=True) for a, b in zip(one, other, strict=True))


def test_a_sequence_that_fails_changes_no_other(tours, alone):
    refused = tours[1][1].image

    class Refuses(Brightness):
        def forward(self, image):
            if any(torch.equal(255 * one, self.refused) for one in image):
                raise ValueError("not this image")
            return super().forward(image)

    source = networks(Refuses(1.0, spread=0.02), Refuses(1.2, spread=0.02), preprocess=Preprocess(size=(72, 96)))
    x = source._turns.prepare(torch.from_numpy(refused.copy()).permute(2, 0, 1)[None], torch.eye(3)[None])[0]
    for member in source.networks:
        member.refused = 255 * x[0]
    unreadable = broken_at(tours[2], 0, FrameError("image", "cannot be decoded"))
    sequences = [
        tours[0],
        tours[1],  # the network refuses an image of it
        broken_at(tours[2], 1, ValueError("a file of another kind")),
        unreadable,
        replace(tours[3], entries=()),
        tours[3],
    ]
    outcomes = []
    tasks = [SequenceTask(sequence, ROWS) for sequence in sequences]
    judge = Judge({"ensemble": source}, CPU, streams=3)
    evaluate_sequences(iter(tasks), judge, lambda task, outcome: outcomes.append((task, outcome)))
    found = dict(outcomes)
    assert len(outcomes) == len(tasks)
    assert [str(found[tasks[n]]) for n in (1, 2, 4)] == [
        "not this image",
        "a file of another kind",
        "no frame is selected of 0",
    ]
    for n, expected in ((0, alone[0]), (5, alone[3])):
        assert all(same(a, b) for a, b in zip(expected, found[tasks[n]], strict=True))
    skipped = found[tasks[3]][0].frames
    assert (skipped["done"], skipped["reasons"]) == (LENGTHS[2] - 1, {"cannot be decoded": 1})
    (expected,) = evaluate_all([unreadable], ROWS, ensemble()[0])
    assert all(same(a, b) for a, b in zip(expected, found[tasks[3]], strict=True))


def test_a_mistake_of_ours_ends_all_and_stopping_too(tours):
    with pytest.raises(TypeError, match="ours"):
        evaluate_all([tours[0], broken_at(tours[2], 1, TypeError("ours"))], ROWS[:1], ensemble()[0], streams=2)
    seen = []
    with pytest.raises(Stopped):
        evaluate_all(tours, ROWS[:1], ensemble()[0], streams=2, stop=lambda: len(seen) > 5,
                     progress=lambda *at: seen.append(at))  # fmt: skip
    with pytest.raises(ValueError, match="streams must be at least 1"):
        Judge({}, CPU, streams=0)


def test_networks_that_draw_samples_draw_the_same(tours, tmp_path):
    file = write_network(tmp_path / "mcd.safetensors", "mc_dropout")
    bases = {"mc_dropout": base_network(f"mc_dropout=trained:{file}", samples=2)}
    rows = [row("UfM*-MCD"), row("MC-Dropout")]
    alone, together = (evaluate_all(tours[1:], rows, bases, streams=n) for n in (1, 2))
    assert all(same(a, b) for one, other in zip(alone, together, strict=True) for a, b in zip(one, other, strict=True))


@pytest.mark.slow
def test_a_convolutional_network_gives_nearly_the_same(tours, tmp_path):
    file = write_network(tmp_path / "net.safetensors", "aleatoric", 2)
    bases = {"ensemble": base_network(f"ensemble=trained:{file}")}
    alone, together = (evaluate_all(tours, [row("Ensemble")], bases, streams=n) for n in (1, 3))
    for (one,), (other,) in zip(alone, together, strict=True):
        assert one.frames == other.frames
        figures = ("rmse", "nll", "delta1")
        assert [other.figures[f] for f in figures] == pytest.approx([one.figures[f] for f in figures], rel=1e-4)


def test_a_folder_is_the_same_and_what_was_stopped_goes_on(tmp_path):
    rooms = write_rooms(tmp_path / "rooms")
    (rooms / "birch" / "depth" / "8.png").write_bytes(b"broken")
    whole = job_on(rooms, tmp_path / "whole")
    assert go(whole, evaluate_sequences)[0]
    job = replace(job_on(rooms, tmp_path / "out"), streams=2)
    done = []
    ended, _ = go(job, evaluate_sequences, stop=lambda: len(done) > 3, progress=lambda *at: done.append(at))
    assert not ended
    assert not kept(job.out)
    ended, lines = go(job, evaluate_sequences, resume=True)
    assert ended
    assert kept(job.out) == kept(whole.out)
    assert not EvalFolder(job.out).failures(job.items)
    assert [line.split(":")[0] for line in lines] == [f"rooms/{name}" for name in NAMES]
