"""JPEG pictures to H.264 frames as an AR.Drone 2.0 sends them. Imports av (PyAV)."""

from collections.abc import Iterator
from fractions import Fraction
from typing import Any, NamedTuple

import av
from av.error import FFmpegError
from av.video.frame import PictureType

WIDTH_PX, HEIGHT_PX = 640, 360  # as displayed; coded in whole macroblocks, 640 x 368
RATE_HZ = 30  # frames a second, for the encoder's rate control
IDR_EVERY = 30  # frames, chosen: who has lost one waits a second at most
BIT_RATE = 1_000_000  # bit/s: video:bitrate of the SDK, 1000 kbit/s
IDR, SPS, PPS = 5, 7, 8  # types of NAL units (ITU-T H.264, table 7-1)
PRESET = {"preset": "ultrafast", "tune": "zerolatency", "profile": "baseline", "x264-params": "annexb=1"}


class VideoError(ValueError):
    """A picture cannot be read."""


class VideoFrame(NamedTuple):
    """A frame: its NAL units with start codes.

    Attributes:
        data: of one picture.
        is_idr: whether decoding can begin here; then SPS and PPS are in it.
        sps_size, pps_size: bytes of these, start codes included; 0 where they are not in it.
    """

    data: bytes
    is_idr: bool
    sps_size: int
    pps_size: int


class VideoEncoder:
    """Encodes one stream."""

    def __init__(self) -> None:
        codec: Any = av.CodecContext.create("libx264", "w")
        codec.width, codec.height, codec.pix_fmt = WIDTH_PX, HEIGHT_PX, "yuv420p"
        codec.time_base, codec.framerate = Fraction(1, RATE_HZ), Fraction(RATE_HZ)
        codec.bit_rate, codec.gop_size, codec.max_b_frames = BIT_RATE, IDR_EVERY, 0
        codec.thread_count = 1
        codec.options = PRESET
        self._codec = codec
        self._count = 0

    def encode(self, jpeg: bytes, begins: bool) -> VideoFrame | None:
        """Return the frame of a picture.

        Args:
            jpeg: the picture.
            begins: whether decoding is to be able to begin here.

        Raises:
            VideoError: it is no JPEG that can be read.
        """
        picture = _picture(jpeg).reformat(WIDTH_PX, HEIGHT_PX, "yuv420p")
        picture.pts, picture.time_base = self._count, self._codec.time_base
        picture.pict_type = PictureType.I if begins else PictureType.NONE
        self._count += 1
        data = b"".join(bytes(packet) for packet in self._codec.encode(picture))
        return _frame(data) if data else None


def _picture(jpeg: bytes) -> Any:
    reader: Any = av.CodecContext.create("mjpeg", "r")
    try:
        pictures = reader.decode(av.Packet(jpeg))
    except (FFmpegError, ValueError) as error:
        raise VideoError(f"it is no JPEG that can be read ({error})") from error
    if not pictures:
        raise VideoError("it is no JPEG that can be read")
    return pictures[0]


def _frame(data: bytes) -> VideoFrame:
    sizes = {kind: size for kind, size in nal_units(data) if kind in (IDR, SPS, PPS)}
    return VideoFrame(data, IDR in sizes, sizes.get(SPS, 0), sizes.get(PPS, 0))


def nal_units(data: bytes) -> Iterator[tuple[int, int]]:
    """Yield type and size of each NAL unit, its start code included (ITU-T H.264, annex B)."""
    starts = []
    at = data.find(b"\0\0\1")
    while at >= 0:
        starts.append((at - 1 if at and data[at - 1] == 0 else at, at + 3))
        at = data.find(b"\0\0\1", at + 3)
    ends = [begin for begin, _ in starts[1:]] + [len(data)]
    for (begin, content), end in zip(starts, ends, strict=True):
        if content < len(data):
            yield data[content] & 0x1F, end - begin
