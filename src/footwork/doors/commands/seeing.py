"""Seeing the ant: a replay, a video, and the page where one steers it."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro

from footwork.doors.commands import say

if TYPE_CHECKING:
    from footwork.doors.replay import Replay as Filmed

RowNames = Annotated[tuple[str, ...], tyro.conf.Positional]
Output = Annotated[Path, tyro.conf.arg(aliases=("-o",))]


@dataclass(frozen=True)
class _Film:
    """Which episodes of which rows are shown."""

    rows: RowNames  # rows or run directories; several are shown side by side
    to: Output
    runs: Path = Path("runs")  # where runs are kept; a row not found there comes from the package
    episodes: int = 1  # of each row, side by side; of sub-policies, in each direction
    seed: int = 0  # of the episodes
    steps: int | None = None  # control steps to show of each episode; default: all
    deterministic: bool = False  # act by the mode of the distribution instead of a sample
    threads: int = 0  # of the physics; 0: all cores. Changes no number

    def film(self) -> Filmed:
        """The episodes, filmed, once it is sure that what is made of them can be written."""
        from footwork.checkpoint import check_writable
        from footwork.doors.replay import replay

        check_writable(self.to)
        return replay(
            *self.rows,
            episodes=self.episodes,
            seed=self.seed,
            runs=self.runs,
            deterministic=self.deterministic,
            most_steps=self.steps,
            num_threads=self.threads,
            report=say,
        )


@dataclass(frozen=True)
class Replay(_Film):
    """Write an HTML page that shows the ant in 3-D: play, scrub, follow. It opens from disk and fetches nothing."""

    to: Output = Path("ant.html")  # the page

    def run(self) -> int:
        """Film, and write the page."""
        if self.to.suffix not in ("", ".html", ".htm"):
            raise ValueError(f"a replay is a page, and {self.to} does not end in .html (footwork video makes videos)")
        page = self.film()
        path = page.save(self.to)
        steps = sum(episode.num_steps for episode in page.footage)
        print(f"wrote {path}: {len(page.footage)} episodes, {steps} control steps, {path.stat().st_size / 1e6:.2f} MB")
        return 0


@dataclass(frozen=True)
class Video(_Film):
    """Write a video of the ant: .mp4 (extra footwork[video]), .webp or .gif."""

    to: Output = Path("ant.webp")  # the file; its ending says which kind
    camera: Literal["follow", "arena", "above"] = "follow"
    width: int = 640  # px, of each episode
    height: int = 480  # px
    fps: int = 30
    speed: float = 1.0  # seconds of the ant per second of video
    quality: int = 80  # 1..100

    def run(self) -> int:
        """Film, draw, and write the video."""
        from footwork.doors.video import Look, check_suffix, video

        check_suffix(self.to.suffix)  # before the work
        look = Look(self.width, self.height, self.fps, self.speed, self.camera, self.quality)
        path = video(self.film().footage, self.to.suffix, look, say).save(self.to)
        print(f"wrote {path}: {path.stat().st_size / 1e6:.2f} MB")
        return 0


@dataclass(frozen=True)
class Play:
    """Serve a page where one watches a master, is the master, draws a maze and lets a master learn it."""

    row: Annotated[str, tyro.conf.Positional] = "maze/hrl/symmetric-interleaved"  # a master, or its run directory
    runs: Path = Path("runs")  # where runs are kept; a row not found there comes from the package
    host: str = "127.0.0.1"  # other addresses open the page to other machines
    port: int = 8765  # 0: any free one
    seats: int = 2  # visitors at once, each with ants of their own; others wait
    lesson_steps: int = 1_000_000  # control steps of a master that learns on the page

    def run(self) -> int:
        """Serve until interrupted."""
        from footwork.doors.play import play

        play(self.row, self.runs, self.host, self.port, self.seats, self.lesson_steps)
        return 0
