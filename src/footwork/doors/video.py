"""Video: filmed episodes as MP4 (extra ``[video]``), animated WebP or GIF; rows side by side."""

from __future__ import annotations

import base64
import io
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from footwork.arena import DIRECTIONS
from footwork.checkpoint import write_atomically
from footwork.doors.replay import OUTCOMES
from footwork.footage import NOBODY, Footage
from footwork.render import CameraName, FilmPainter, choose_platform, colour_of

SUFFIXES = (".mp4", ".webp", ".gif")
MOST_PIXELS = 4096  # of a picture each way: what renderers have room for
WEBP_PIXELS = 16383  # the format's own limit, for all pictures side by side
FASTEST = 1000.0
HOLD_SECONDS = 1.0  # the last picture stays

_INK = (35, 38, 43)
_FAINT = (107, 112, 120)
_GREEN = (0, 158, 115)


@dataclass(frozen=True)
class Look:
    """How a video is made.

    Args:
        width: px of one episode's picture, even.
        height: px, even.
        fps: pictures per second.
        speed: seconds of the ant per second of video.
        camera: follow the ant, show the whole arena, or look from above.
        quality: 1..100; of MP4, 80 is visually lossless.
    """

    width: int = 640
    height: int = 480
    fps: int = 30
    speed: float = 1.0
    camera: CameraName = "follow"
    quality: int = 80

    def __post_init__(self) -> None:
        for field in ("width", "height"):
            if not 32 <= getattr(self, field) <= MOST_PIXELS or getattr(self, field) % 2:
                raise ValueError(f"{field} must be even and in 32..{MOST_PIXELS}, got {getattr(self, field)}")
        if not 1 <= self.fps <= 120:
            raise ValueError(f"fps must be in 1..120, got {self.fps}")
        if not 0 < self.speed <= FASTEST:
            raise ValueError(f"speed must be > 0 and <= {FASTEST:g}, got {self.speed}")
        if self.camera not in ("follow", "arena", "above"):
            raise ValueError(f"camera must be follow, arena or above, got {self.camera!r}")
        if not 1 <= self.quality <= 100:
            raise ValueError(f"quality must be in 1..100, got {self.quality}")


@dataclass(frozen=True, eq=False)
class Video:
    """A video in memory; shows itself in a notebook.

    Args:
        data: the file's bytes.
        suffix: its kind, ``.mp4``, ``.webp`` or ``.gif``.
    """

    data: bytes
    suffix: str

    def save(self, path: Path) -> Path:
        """Write it."""
        path.parent.mkdir(parents=True, exist_ok=True)
        write_atomically(path, self.data)
        return path

    def _repr_html_(self) -> str:
        text = base64.b64encode(self.data).decode()
        if self.suffix == ".mp4":
            return f'<video controls loop autoplay muted src="data:video/mp4;base64,{text}"></video>'
        return f'<img src="data:image/{self.suffix[1:]};base64,{text}">'


def video(
    footage: Sequence[Footage],
    suffix: str = ".webp",
    look: Look | None = None,
    report: Callable[[str], None] = lambda line: None,
) -> Video:
    """Make a video of episodes side by side.

    Args:
        footage: one or several episodes.
        suffix: the kind of file.
        look: size, speed, camera.
        report: told once why the ant is drawn from above, where it is.

    Raises:
        ValueError: no episode, or an unknown suffix.
        ImportError: MP4 without PyAV; names the extra.
    """
    check_suffix(suffix)
    if not footage:
        raise ValueError("footage must hold at least one episode, got none")
    look = look or Look()
    if suffix == ".webp" and look.width * len(footage) > WEBP_PIXELS:
        raise ValueError(
            f"a WebP is at most {WEBP_PIXELS} px wide, and {len(footage)} episodes of {look.width} px are more: "
            "make them narrower, or another kind of file"
        )
    platform, reason = choose_platform()
    if platform is None:
        report(f"drawn from above with a pen, there being no OpenGL here ({reason})")
    pictures = _pictures(footage, look, platform)
    encode = _encode_mp4 if suffix == ".mp4" else _encode_animation
    return Video(encode(pictures, look, suffix), suffix)


def check_suffix(suffix: str) -> None:
    """Refuse a kind of file that cannot be made here.

    Raises:
        ValueError: an unknown one.
        ImportError: MP4 without PyAV.
    """
    if suffix not in SUFFIXES:
        raise ValueError(f"a video's name must end in one of {', '.join(SUFFIXES)}, got {suffix or 'no ending'!r}")
    if suffix == ".mp4" and find_spec("av") is None:
        raise ImportError("MP4 needs PyAV: pip install 'footwork[video]'; a name ending in .webp needs no extra")


def _pictures(footage: Sequence[Footage], look: Look, platform: str | None) -> Iterator[Image.Image]:
    """One after the other, all episodes side by side."""
    longest = max(episode.num_steps for episode in footage)
    per_picture = look.speed / (look.fps * footage[0].control_dt)  # control steps
    count = int(np.ceil(longest / per_picture)) + 1
    painters = [FilmPainter(episode, look.width, look.height, look.camera, platform) for episode in footage]
    try:
        for number in range(count):
            step = min(round(number * per_picture), longest)
            whole = Image.new("RGB", (look.width * len(footage), look.height))
            for place, (episode, paints) in enumerate(zip(footage, painters, strict=True)):
                here = min(step, episode.num_steps)
                picture = Image.fromarray(paints.paint(here))
                _caption(picture, episode, here)
                whole.paste(picture, (place * look.width, 0))
            yield whole
        for _ in range(round(HOLD_SECONDS * look.fps)):
            yield whole
    finally:
        for paints in painters:
            paints.close()


def _caption(picture: Image.Image, footage: Footage, step: int) -> None:
    """The row, the sub-policy at work, time and return, in the picture's lower left corner."""
    finer, unit = 2, picture.height / 480
    layer = Image.new("RGBA", (round(250 * unit) * finer, round(92 * unit) * finer), (0, 0, 0, 0))
    pen, u = ImageDraw.Draw(layer), unit * finer
    choice = int(footage.choice[max(step - 1, 0)])
    tint = tuple(round(255 * channel) for channel in colour_of(choice))
    word = "flat policy" if choice == NOBODY else f"{DIRECTIONS[choice]}"
    total = float(footage.reward[:step].sum(dtype=np.float64))
    small, large = ImageFont.load_default(12 * u), ImageFont.load_default(13 * u)
    lines = f"{step * footage.control_dt:5.1f} s    return {total:.0f}"
    widest = max(pen.textlength(footage.row, font=large), pen.textlength(lines, font=small), 120 * u)
    pen.rounded_rectangle([8 * u, 8 * u, 28 * u + widest, 84 * u], 8 * u, fill=(255, 255, 255, 214))
    pen.text((18 * u, 14 * u), footage.row, font=large, fill=_INK)
    pen.rounded_rectangle([18 * u, 35 * u, 34 * u + pen.textlength(word, font=small), 54 * u], 9 * u, fill=tint)
    pen.text((26 * u, 37 * u), word, font=small, fill="white")
    pen.text((18 * u, 61 * u), lines, font=small, fill=_FAINT)
    _stamp(picture, layer, finer, top=picture.height - layer.height // finer)
    if step == footage.num_steps:
        _badge(picture, f"{OUTCOMES[footage.outcome]}", _GREEN if footage.outcome == "reached" else _FAINT)
    elif step and footage.flipped[step - 1]:
        _badge(picture, "upside down", (179, 38, 30))


def _badge(picture: Image.Image, text: str, colour: tuple[int, ...]) -> None:
    finer, unit = 2, picture.height / 480
    u = unit * finer
    layer = Image.new("RGBA", (picture.width * finer, round(44 * u)), (0, 0, 0, 0))
    pen, font = ImageDraw.Draw(layer), ImageFont.load_default(14 * u)
    length, right = pen.textlength(text, font=font), picture.width * finer - 10 * u
    pen.rounded_rectangle([right - length - 24 * u, 10 * u, right, 36 * u], 12 * u, fill=(*colour, 255))
    pen.text((right - length - 12 * u, 14 * u), text, font=font, fill="white")
    _stamp(picture, layer, finer)


def _stamp(picture: Image.Image, layer: Image.Image, finer: int, top: int = 0) -> None:
    small = layer.resize((layer.width // finer, layer.height // finer), Image.Resampling.BOX)
    picture.paste(small, (0, top), small)


def _encode_animation(pictures: Iterator[Image.Image], look: Look, suffix: str) -> bytes:
    first, *rest = list(pictures)
    options: dict[str, object] = {"save_all": True, "append_images": rest, "loop": 0, "duration": 1000 / look.fps}
    if suffix == ".webp":
        options |= {"duration": round(1000 / look.fps), "quality": look.quality, "method": 4}
    buffer = io.BytesIO()
    first.save(buffer, suffix[1:], **options)
    return buffer.getvalue()


def _encode_mp4(pictures: Iterator[Image.Image], look: Look, suffix: str) -> bytes:
    import av

    buffer = io.BytesIO()
    with av.open(buffer, "w", format="mp4") as container:
        stream = None
        for picture in pictures:
            if stream is None:
                crf = str(round(38 - 0.25 * look.quality))
                stream = container.add_stream("libx264", rate=look.fps, options={"crf": crf, "preset": "medium"})
                stream.width, stream.height, stream.pix_fmt = picture.width, picture.height, "yuv420p"
            container.mux(stream.encode(av.VideoFrame.from_image(picture)))
        if stream is not None:
            container.mux(stream.encode())
    return buffer.getvalue()


__all__ = ["Look", "Video", "check_suffix", "video"]
