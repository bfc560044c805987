"""What decodes a film, in a process of its own (`pipeline.untrusted.child`)."""

from __future__ import annotations

import importlib
import os
import pkgutil
from bisect import bisect_left, bisect_right
from collections.abc import Generator, Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any, BinaryIO

import av

from pipeline.untrusted.child import Arrays, Reply, Values
from pipeline.untrusted.files import UnusableFile
from pipeline.untrusted.films import MAX_PIXELS, opened_film, promised_size
from stages.views.reading.shown import shown, shown_size, turn_of
from stages.views.sampling import even_in_time, uniform_indices

#: Readers of films that hold an index of their frames.
WITH_INDEX = ("mov", "matroska")
#: Bytes that a film may be shorter than it says: some programs count its head twice.
SLACK = 64
#: Pixels of the long side of a glance.
GLANCE = 64
#: Frames to glance at for each that is wanted, at most, and key frames, at least.
GLANCES, FEWEST_KEYS = 8, 0.75

for _module in pkgutil.walk_packages(av.__path__, "av."):  # it imports most of them when used
    if not _module.name.endswith((".__main__", ".datasets")):
        importlib.import_module(_module.name)


@dataclass(frozen=True)
class _Contents:
    """What a film's packets say of its frames, in the order in which they are shown.

    Attributes:
        count: how many there are.
        shown: [count] when each is shown, in units of the stream; empty where they don't tell.
        keys: numbers of the key frames, at which decoding may start; empty where that is unknown.
    """

    count: int
    shown: list[int] = field(default_factory=list)
    keys: list[int] = field(default_factory=list)


def work(values: Values, arrays: Arrays) -> Iterator[Reply]:
    """Frames of the film behind an open descriptor: these ``indices``, or ``wanted`` ones that are
    even in time (where the packets don't tell it, by number), and ``also`` others.

    The packets are counted first. Then each frame is decoded from the key frame before it, or,
    where packets don't tell these, the whole film once. If the film is not as its packets say
    (damaged, or cut without re-encoding) ``again`` comes, and the frames before it don't count.

    Or, if asked to ``glance`` at ``keys`` or ``all``, small grey pictures of more of them; none of
    a film of no more frames than are wanted.
    """
    with os.fdopen(int(values["file"]), "rb", closefd=False) as file:
        try:
            contents = yield from _contents(file)
            count = contents.count
            if count == 0:
                raise UnusableFile("has no video frames in it")
            wanted, threads = int(values["wanted"]), int(values["threads"])
            if values.get("glance"):
                if count > wanted:
                    by_keys = values["glance"] == "keys"
                    yield from _glance(file, wanted, contents, threads, by_keys)
                return
            if contents.keys:
                indices = _indices(values, count, contents.shown)
                if (yield from _decode_from_keys(file, indices, contents, threads)):
                    return
                yield {"again": True}, []
            indices = _indices(values, count, contents.shown)
            found = yield from _decode(file, indices, count, threads)
            if found not in (0, count):
                yield {"again": True}, []
                yield from _decode(file, _indices(values, found), found, threads)
        except MemoryError:
            raise
        except (av.error.FFmpegError, OSError, ValueError) as error:
            reason = getattr(error, "strerror", None) or str(error)
            raise UnusableFile(f"can't be read as a video ({reason})") from error


def _indices(values: Values, count: int, shown: Sequence[int] = ()) -> list[int]:
    """Numbers of the frames to take of a film that has so many, which are shown then."""
    given, wanted = [int(index) for index in values["indices"]], int(values["wanted"])
    even = even_in_time(shown, wanted) if shown else uniform_indices(count, wanted)
    spread = given if given and given[-1] < count else even
    return sorted({*spread, *(index for index in values["also"] if 0 <= index < count)})


def _contents(file: BinaryIO) -> Generator[Reply, None, _Contents]:
    """What is in the film; says now and then that it is at work."""
    packets: list[tuple[int | None, bool]] = []
    number = 0  # the last packet holds nothing
    with opened_film(file) as container:
        stream = _video(container)
        check_size(stream.codec_context.width, stream.codec_context.height)
        for number, packet in enumerate(container.demux(stream)):
            if packet.size and not packet.is_discard:
                packets.append((packet.pts, packet.is_keyframe))
            if number % 500 == 0:
                yield {"counted": len(packets)}, []
        known = container.format.name.startswith(WITH_INDEX)
        if number < stream.frames and container.format.name.startswith("mov"):
            yield {"there": number, "of": stream.frames}, []
    there, promised = os.fstat(file.fileno()).st_size, promised_size(file)
    if there + SLACK < promised:
        yield {"share": there / promised}, []
    timed = sorted((time, key) for time, key in packets if time is not None)
    shown, keys = [time for time, _ in timed], [n for n, (_, key) in enumerate(timed) if key]
    if not known or keys[:1] != [0] or len(set(shown)) < len(packets):
        return _Contents(len(packets))
    return _Contents(len(packets), shown, keys)


def _video(container: Any) -> Any:
    if not container.streams.video:
        raise UnusableFile("has no video in it, only other streams")
    stream = container.streams.video[0]
    if stream.codec_context is None:
        raise UnusableFile(
            "can't be read as a video: its pictures are coded in a way that is not known here"
        )
    return stream


def check_size(width: int, height: int) -> None:
    """Refuse frames that are larger than films have."""
    if width * height > MAX_PIXELS:
        raise UnusableFile(
            f"has frames of {width} x {height} pixels, more than the "
            f"{MAX_PIXELS // 1_000_000} megapixels that can be read of a film"
        )


def _opened(container: Any, threads: int) -> Any:
    stream = _video(container)
    stream.thread_type = "AUTO"
    stream.codec_context.thread_count = threads
    return stream


def _reply(index: int, frame: Any, start: float, size: tuple[int, int]) -> Reply:
    """Frame number `index`, at this size, of a film whose first is shown at `start` seconds."""
    seconds = frame.time - start if frame.time is not None else index
    values = {"index": index, "orientation": turn_of(frame), "seconds": round(float(seconds), 6)}
    return values, [shown(frame, size)]


def _glance(
    file: BinaryIO, wanted: int, contents: _Contents, threads: int, by_keys: bool
) -> Iterator[Reply]:
    """Small grey pictures of frames all over the film, with the number of each.

    Args:
        by_keys: of key frames; none where these are unknown or too few to tell anything.
    """
    count, shown = contents.count, contents.shown
    places = contents.keys if by_keys else range(count)
    if by_keys and len(places) < FEWEST_KEYS * wanted:
        return
    awaited = [places[k] for k in uniform_indices(len(places), GLANCES * wanted)]
    with opened_film(file) as container:
        stream = _opened(container, threads)
        if shown:  # frames that no other needs are left out: one that is awaited is then late
            stream.codec_context.skip_frame = "NONKEY" if by_keys else "NONREF"
        frames = enumerate(container.decode(stream))
        while True:
            try:
                number, frame = next(frames)
            except StopIteration:
                return
            except av.error.FFmpegError:  # the frames that are wanted may be sound all the same
                yield {"damaged": True}, []
                return
            at = bisect_left(shown, frame.pts) if shown and frame.pts is not None else number
            check_size(frame.width, frame.height)
            if awaited and at >= awaited[0]:
                del awaited[: bisect_right(awaited, at)]
                scale = GLANCE / max(frame.width, frame.height)
                width, height = (max(1, round(n * scale)) for n in (frame.width, frame.height))
                small = frame.reformat(width, height, "gray", interpolation="AREA")
                yield {"index": at, "of": count}, [small.to_ndarray()]
            elif number % 10 == 0:
                yield {"counted": number}, []


def _frames(container: Any, stream: Any) -> Iterator[Any]:
    """Frames in the order in which they are shown; None for packets that are damaged.

    Raises:
        av.error.InvalidDataError: all are.
    """
    problem, count = None, 0
    for packet in container.demux(stream):
        try:
            frames = packet.decode()
        except av.error.InvalidDataError as error:
            problem = problem or error
            yield None
            continue
        count += len(frames)
        yield from frames
    if problem is not None and count == 0:
        raise problem


def _decode_from_keys(
    file: BinaryIO, indices: list[int], contents: _Contents, threads: int
) -> Generator[Reply, None, bool]:
    """The frames at `indices`, no others but those between them and the key frames before them.

    False if the film can't be entered at these, or a frame comes damaged, or not when the packets
    say.
    """
    keys, at, start = contents.keys, -1, 0.0
    with opened_film(file) as container:
        stream = _opened(container, threads)
        frames = _frames(container, stream)
        for index in indices:
            key = keys[bisect_right(keys, index) - 1]
            if key > at + 1:
                try:
                    container.seek(contents.shown[key], stream=stream)
                except av.error.FFmpegError:
                    return False
                frames, at = _frames(container, stream), key - 1
            while at < index:
                frame, at = next(frames, None), at + 1
                if frame is None or frame.is_corrupt or frame.pts != contents.shown[at]:
                    return False
                size = shown_size(stream, frame)
                check_size(*size)
                if at == 0:
                    yield {"size": [*size]}, []
                    start = frame.time or 0.0
                if at % 10 == 0:
                    yield {"done": at + 1, "of": contents.count}, []
            yield _reply(index, frame, start, size)
    return True


def _decode(
    file: BinaryIO, indices: list[int], count: int, threads: int
) -> Generator[Reply, None, int]:
    """The frames at `indices`; returns how many the film has."""
    chosen, start, index = set(indices), 0.0, -1
    with opened_film(file) as container:
        stream = _opened(container, threads)
        for frame in _frames(container, stream):
            if frame is None:
                yield {"left_out": True}, []
                continue
            index += 1
            size = shown_size(stream, frame)
            check_size(*size)
            if index == 0:
                yield {"size": [*size]}, []
                start = frame.time or 0.0
            if index in chosen:
                yield _reply(index, frame, start, size)
            if index % 10 == 0:
                yield {"done": min(index + 1, count), "of": count}, []
    return index + 1
