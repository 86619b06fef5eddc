"""What a tuning keeps while it runs, and how it goes on from there."""

import resource
from pathlib import Path

import pytest
from tests.unit.test_tuning_tune import RUN, tuned

from holdfast.errors import OutputError
from holdfast.tuning.tune import Progress


@pytest.fixture
def run(tmp_path: Path) -> Path:
    path = tmp_path / "run.yaml"
    path.write_text(RUN)
    return path


def test_it_goes_on_where_it_was_interrupted(run: Path) -> None:
    out, whole = run.parent / "tuned", run.parent / "whole"

    def interrupt(progress: Progress) -> None:
        if progress.trials == 17:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        tuned(run, out=out, on_progress=interrupt)
    trials = out / "trials.csv"
    kept = trials.read_text()
    assert len(kept.splitlines()) == 1 + 17
    trials.write_text(kept + "as configured,9,1")  # a kill has cut it short
    found = tuned(run, out=out)
    assert trials.read_text().startswith(kept)
    again = tuned(run, out=whole)
    assert (found.sentence, found.choice) == (again.sentence, again.choice)
    assert found.comparisons == again.comparisons
    with pytest.raises(OutputError, match=r"objective was 'steps' and is 'success'"):
        tuned(run, out=out, objective="success")


def test_damaged_files(run: Path) -> None:
    out = run.parent / "tuned"
    tuned(run, out=out)
    trials, settings = out / "trials.csv", out / "tune.json"
    whole, known = trials.read_bytes(), settings.read_bytes()
    head, first, rest = whole.split(b"\n", 2)
    odd = [b"", b"\xff\xfe", b"random,1,\x00", b'"always x', b"a" * 200_000, first[:-9] + b"inf"]
    trials.write_bytes(b"\n".join([head, *odd, rest]) + first[:-9])
    tuned(run, out=out)
    again = trials.read_bytes()
    assert again.startswith(b"\n".join([head, *odd, rest]))  # nothing was lost, nothing cut
    assert len(again.splitlines()) == len(whole.splitlines()) + len(odd)  # one trial was run again
    settings.write_bytes(b'{"objective": "\xff"}')
    with pytest.raises(OutputError, match=r"tune\.json: cannot be read: "):
        tuned(run, out=out)
    settings.unlink()
    for content in (b"trial,seed\n0,1\n", again):  # the first is of a run
        trials.write_bytes(content)
        with pytest.raises(OutputError, match=r"tune\.json: is not there, so trials\.csv is of"):
            tuned(run, out=out)
        assert trials.read_bytes() == content
    settings.write_bytes(known)
    tuned(run, out=out)


def test_a_full_disk_is_an_error_in_words(run: Path) -> None:
    out = run.parent / "tuned"
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (2_500, before[1]))
    try:
        with pytest.raises(OutputError, match=r"trials\.csv: cannot be written: "):
            tuned(run, out=out, most=100)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
    kept = (out / "trials.csv").read_bytes()
    assert len(kept) == 2_500
    tuned(run, out=out)
    assert (out / "trials.csv").read_bytes().startswith(kept[: kept.rfind(b"\n") + 1])
