"""What a report keeps of its runs: their small files in ``results/``, and when a folder may be written over."""

from __future__ import annotations

import shutil
from collections.abc import Sequence
from pathlib import Path

import jax
import numpy as np

from footwork import checkpoint
from footwork.checkpoint import CheckpointError
from footwork.record import RunError
from footwork.study.measure import files_of
from footwork.study.plan import STUDY_FILE, Study, read_mark
from footwork.study.results import Results, Sample, all_rows
from footwork.study.runs import NEEDED, read_actors
from footwork.study.training_curves import CURVE, copy_curve

REPORT = "REPORT.md"
PAGES = (REPORT, "report.html")  # the report itself, twice
RESULTS = "results"  # folder of a report, with the small files of its runs
WRITTEN = "WRITTEN_BY_FOOTWORK_REPORT"  # in that folder: the next report may replace it


def check_place(study: Study, to: Path) -> None:
    """Refuse a folder for the report in which writing it would cost something that the study's runs do not hold.

    What a report that was killed in the middle had put aside is brought back first.

    Raises:
        RunError: ``to`` is the folder of runs, or holds pages that no report wrote, or ``to``/results holds the
            runs, something that no report wrote, another study, or runs that these lack.
        CheckpointError: nothing can be written there.
    """
    place, runs = to / RESULTS, study.runs
    if runs.resolve() == to.resolve():
        raise RunError(f"{to} is the folder of the runs: choose another --to for the report")
    checkpoint.check_writable(to / REPORT)
    aside = _beside(place)[1]
    if aside.exists() and not place.exists():
        aside.rename(place)
    if runs.resolve() == place.resolve():  # a report made again from its own files leaves them as they are
        return
    if runs.resolve().is_relative_to(place.resolve()):
        raise RunError(f"{place} would be replaced, and the runs in {runs} are in it: choose another --to")
    if not (place / WRITTEN).is_file():
        empty = not place.exists() or (place.is_dir() and not any(place.iterdir()))
        foreign = [*([] if empty else [RESULTS]), *(name for name in PAGES if (to / name).exists())]
        if foreign:
            raise RunError(
                f"{to} holds {foreign[0]}, and no report wrote it (no {place / WRITTEN}): choose another --to"
            )
        return
    if read_mark(place) != study.size:
        raise RunError(
            f"{place} is of the {read_mark(place).name} study, not of the {study.size.name} one: choose another --to"
        )
    there = sorted(path.parent.relative_to(place) for path in place.rglob("DONE"))
    lost = [path for path in there if not (runs / path / "DONE").is_file()]
    if lost:
        many = f"{len(lost)} finished runs" if len(lost) > 1 else "a finished run"
        copy = f"mkdir -p {runs} && cp -rn {place}/. {runs}"
        raise RunError(
            f"{place} would be replaced, and it holds {many} that {runs} lacks ({lost[0]}): to go on with that study "
            f"copy what is missing ({copy}), else choose another --to"
        )


def _beside(place: Path) -> tuple[Path, Path]:
    """Where results are built, and where the ones before are put while they change places."""
    return place.with_name(f".{place.name}.new"), place.with_name(f".{place.name}.old")


def export(results: Results, to: Path) -> None:
    """Copy the small files of every run that was read: enough to draw and to judge again.

    And policies, without their critics: of every seed where other rows stand on them, so that ``footwork reproduce``
    goes on from a copy of this folder as it would from the runs themselves; else of the first seed, so that each row
    can be watched and evaluated from here. A master finds its sub-policies beside it, under the same seed.

    What an earlier report wrote there stays until everything has been copied.

    Raises:
        RunError: see :func:`check_place`.
        OSError: they cannot be written.
        CheckpointError: they cannot be written.
    """
    check_place(results.study, to.parent)
    if to.resolve() == results.study.runs.resolve():
        return
    new, old = _beside(to)
    for left in (new, old):
        shutil.rmtree(left, ignore_errors=True)
    new.mkdir(parents=True)
    for samples in results.all_samples().values():  # what they stand on is copied and looked at too
        for needs in {sample.experiment.needs for sample in samples} - {None}:
            results.samples(str(needs))
    stood_on = {results.study.row(row).needs for row in all_rows(results)}
    for row, samples in results.all_samples().items():
        _say_what_stands_elsewhere(results, samples)
        for sample in {sample.run: sample for sample in samples}.values():
            name = f"{row}/{sample.run.path.name}"
            had = (to / name / sample.run.policy_path.name).is_file()
            _copy_run(results, sample, new / name, row in stood_on or had or sample.run == samples[0].run)
    if (results.study.runs / STUDY_FILE).is_file():
        shutil.copyfile(results.study.runs / STUDY_FILE, new / STUDY_FILE)
    (new / WRITTEN).write_text("footwork report wrote this folder, and the next one replaces it.\n", encoding="utf-8")
    lost = sorted(p.relative_to(to) for p in to.rglob("*") if p.is_file() and not (new / p.relative_to(to)).is_file())
    if lost:
        shutil.rmtree(new, ignore_errors=True)
        raise RunError(
            f"{to} would lose {len(lost)} of its files, {lost[0]} among them, which {results.study.runs} has damaged, "
            f"unreadable or not at all: put them back from there, or choose another --to"
        )
    if to.exists():
        to.rename(old)
    new.rename(to)
    shutil.rmtree(old, ignore_errors=True)


def _say_what_stands_elsewhere(results: Results, samples: Sequence[Sample]) -> None:
    """Seed i of a row is to stand on seed i of the row it needs: what it kept of that is compared with what is there.

    A report's own results keep no such copy; there nothing can be compared.
    """
    for sample in samples:
        kept, needs = sample.run.path / NEEDED, sample.experiment.needs
        if needs is None or not kept.is_file():
            continue
        needed = next((other for other in results.samples(needs) if other.seed == sample.seed), None)
        if needed is None:
            said = f"{sample.run.path} stands on {needs} seed {sample.seed}, of which there is no run that counts"
            results.problems[said] = None
            continue
        try:
            mine = jax.tree.leaves(read_actors(kept)[0])
            theirs = [leaf[needed.index] for leaf in jax.tree.leaves(read_actors(needed.run.policy_path)[0])]
        except CheckpointError as error:
            results.problems[f"{error}: what {sample.run.path} stands on cannot be told"] = None
            continue
        if len(mine) != len(theirs) or not all(map(np.array_equal, (leaf[0] for leaf in mine), theirs)):
            said = f"{sample.run.path} stands on other policies than those of {needed.run.path}"
            results.problems[said] = None


def _copy_run(results: Results, sample: Sample, place: Path, with_policy: bool) -> None:
    """Copy what of a run is whole."""
    run = sample.run
    place.mkdir(parents=True, exist_ok=True)
    for name in ("config.json", "DONE"):
        shutil.copyfile(run.path / name, place / name)
    for name in files_of(sample.experiment):
        if results.entry(sample, name) is not None:
            shutil.copyfile(run.path / name, place / name)
    curve = results.whole_curve(sample)
    if curve is not None:
        copy_curve(curve, run, sample.experiment, place / CURVE)
    if with_policy:
        try:
            actors, meta = read_actors(run.policy_path)
        except CheckpointError as error:
            results.problems[f"{error}: the report's results lack it"] = None
        else:
            checkpoint.save(place / run.policy_path.name, actors, meta)


__all__ = ["PAGES", "REPORT", "RESULTS", "check_place", "export"]
