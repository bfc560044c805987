"""Which films are decoded: told from their first bytes, and nothing is read but the file itself.

FFmpeg by itself would also follow playlists, concatenation scripts, patterns of names and network
addresses that stand in a file named ``.mp4``. It gets an open file, the name of the one reader that
may read it, and an answer of no to every other file that it asks for. Call this in a child only
(`child`).
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, BinaryIO, NoReturn

from pipeline.untrusted.files import UnusableFile

if TYPE_CHECKING:
    from av.container import InputContainer

KNOWN = "MP4, MOV, MKV, WebM, AVI, MPEG or WMV"
#: 8K films have 33 megapixels.
MAX_PIXELS = 70_000_000
#: Bytes that decoding may take: 8K at 10 bits with twenty frames held.
MOST_MEMORY = 4 << 30

_ATOMS = (b"ftyp", b"moov", b"mdat", b"free", b"skip", b"wide", b"pnot", b"uuid")
_STARTS = (
    (b"\x1aE\xdf\xa3", "matroska"),
    (b"\x30\x26\xb2\x75\x8e\x66\xcf\x11", "asf"),
    (b"\0\0\1\xba", "mpeg"),
    (b"\0\0\1\xb3", "mpegvideo"),
)
_TEXTS = ((b"ffconcat", "a script of film names"), (b"#EXTM3U", "a playlist"))
#: Bytes of the start of a film that `reader_for` looks at.
HEAD = 1024
#: The name of ASF's object with the size of the whole file.
_PROPERTIES = bytes.fromhex("a1dcab8c47a9cf118ee400c00c205365")


def reader_for(head: bytes) -> str:
    """FFmpeg's name of the reader of a film, from its first bytes.

    Raises:
        UnusableFile: it is no film of a known format.
    """
    if not head:
        raise UnusableFile("is empty (0 bytes)")
    if head[4:8] in _ATOMS:
        return "mov"
    for start, name in _STARTS:
        if head.startswith(start):
            return name
    if head[:4] == b"RIFF" and head[8:11] == b"AVI":
        return "avi"
    for first, step in ((0, 188), (4, 192), (0, 204)):
        if len(head) > first + 3 * step and set(head[first : first + 4 * step : step]) == {0x47}:
            return "mpegts"
    for start, name in _TEXTS:
        if head.lstrip(b"\xef\xbb\xbf \r\n\t").startswith(start):
            raise UnusableFile(
                f"can't be read as a video: it is {name}, and only films themselves are read "
                f"({KNOWN})"
            )
    printable = sum(byte in b"\t\n\r\f" or byte >= 32 for byte in head)
    sort = "a text file" if printable == len(head) else f"not {KNOWN} by its content"
    raise UnusableFile(f"can't be read as a video: it is {sort}")


def opened_film(file: BinaryIO) -> InputContainer:
    """A film, opened by the reader of its format only.

    Args:
        file: at any place; what it is called does not matter.

    Raises:
        UnusableFile: it is no film of a known format.
        av.error.FFmpegError, ValueError: it is damaged.
    """
    import av

    file.seek(0)
    reader = reader_for(file.read(HEAD))
    file.seek(0)
    options = {
        "format_whitelist": "mov,mp4,m4a,3gp,3g2,mj2,matroska,webm,avi,mpegts,mpeg,mpegvideo,asf",
        "protocol_whitelist": "none",
        "max_pixels": str(MAX_PIXELS),
        "max_streams": "100",
    }
    if reader == "mov":
        options |= {"enable_drefs": "0", "use_absolute_path": "0"}
    container: Any = av.open(
        _Nameless(file), format=reader, options=options, io_open=_refuse, metadata_errors="replace"
    )
    return container


def promised_size(file: BinaryIO) -> int:
    """Bytes that a film has by what its head or outermost boxes say, 0 where these do not tell.

    A film with fewer has lost its end, as a copy that was broken off: decoders end there without a
    word. Told of AVI, Matroska, WebM and WMV; of MP4 and MOV the index says more, the number of
    frames; MPEG has nothing that tells.

    Args:
        file: at any place.
    """
    file.seek(0)
    sort = reader_for(file.read(HEAD))
    file.seek(0)
    if sort == "avi":
        return _end_of_riff(file)
    if sort == "asf":
        return _size_in_properties(file)
    return _end_of_segment(file) if sort == "matroska" else 0


def _size_in_properties(file: BinaryIO) -> int:
    """The size in the properties of an ASF (WMV); 0 where it has none, or is a broadcast."""
    place = 30  # behind what the header itself says: its name, size, and number of objects
    for _ in range(100):
        file.seek(place)
        found = file.read(92)
        size = int.from_bytes(found[16:24], "little")
        if len(found) < 92 or not 24 <= size <= 1 << 32:
            return 0
        if found[:16] == _PROPERTIES:
            is_broadcast = found[88] & 1
            return 0 if is_broadcast else int.from_bytes(found[40:48], "little")
        place += size
    return 0


def _end_of_riff(file: BinaryIO) -> int:
    """Where the last of the ``RIFF`` chunks ends; long films have one for each gigabyte."""
    end = 0
    for _ in range(1000):
        file.seek(end)
        head = file.read(8)
        # a film whose recorder lost its power still says 0
        if head[:4] != b"RIFF" or len(head) < 8 or head[4:] == bytes(4):
            break
        size = int.from_bytes(head[4:], "little")
        end += 8 + size + size % 2
    return end


def _end_of_segment(file: BinaryIO) -> int:
    """Where Matroska's ``Segment`` ends; 0 where it does not say, as a stream."""
    for _ in range(8):  # its head, and padding
        name, size = _ebml_number(file, keep=True), _ebml_number(file)
        if name is None or size is None:
            return 0
        if name == 0x18538067:
            return file.tell() + size
        if size > HEAD:
            return 0
        file.seek(size, 1)
    return 0


def _ebml_number(file: BinaryIO, *, keep: bool = False) -> int | None:
    """A number of as many bytes as its first bits say; None: none, or the mark of one not known.

    Args:
        keep: with the bits that say how long it is, as names have them.
    """
    first = file.read(1)
    if not first or not first[0]:
        return None
    length = 9 - first[0].bit_length()
    value = int.from_bytes(first + file.read(length - 1))
    mask = (1 << 7 * length) - 1
    if keep:
        return value
    return None if value & mask == mask else value & mask


class _Nameless:
    """A file to read from without the name that FFmpeg would resolve other names against."""

    def __init__(self, file: BinaryIO) -> None:
        self.read, self.seek, self.tell = file.read, file.seek, file.tell


def _refuse(url: str, flags: int, options: dict[str, Any]) -> NoReturn:
    raise PermissionError(f"a film may not name other files ({url})")
