"""The live video of a drone: a camera's images as H.264 frames preceded by PaVE headers. No I/O.

PaVE is Parrot's video encapsulation, on TCP port 5555. Source: ARDroneLib (SDK 2.0.1), video_encapsulation.h.
"""

import struct
from collections.abc import Iterator
from fractions import Fraction
from typing import Any, NamedTuple

PORT = 5555  # TCP (ARDroneLib, config.h)
SIGNATURE = b"PaVE"
VERSION = 2
CODEC_H264 = 4
HEADER_SIZE = 64  # bytes; later firmware appends four bytes without meaning
# Displayed size; the coded height is a whole number of macroblocks
WIDTH_PX, HEIGHT_PX, CODED_HEIGHT_PX = 640, 360, 368
RATE_HZ = 30  # frames per second, for the encoder's rate control
IDR_INTERVAL = 30  # frames; design choice: after a loss, decoding can resume within a second
BIT_RATE = 1_000_000  # bit/s; the SDK's video:bitrate, 1000 kbit/s
IDR_FRAME, P_FRAME = 1, 3  # frame types in a header; an IDR frame includes SPS and PPS
IDR, SPS, PPS = 5, 7, 8  # types of NAL units (ITU-T H.264, table 7-1)
PRESET = {"preset": "ultrafast", "tune": "zerolatency", "profile": "baseline", "x264-params": "annexb=1"}
_HEADER = struct.Struct("<4sBBHIHHHHIIBBBBIIHBBBB2xI12x")


class VideoError(ValueError):
    """An image cannot be read."""


class VideoFrame(NamedTuple):
    """The NAL units of an image, with start codes.

    Attributes:
        is_idr: whether decoding can begin here; the frame then contains SPS and PPS.
        sps_size, pps_size: sizes of SPS and PPS [bytes], including start codes; 0 if the frame has none.
    """

    data: bytes
    is_idr: bool
    sps_size: int
    pps_size: int


def pave_header(frame: VideoFrame, frame_number: int, timestamp_ms: int, stream_byte_position: int) -> bytes:
    """Return the header of a frame; `stream_byte_position` counts the bytes of all previous frames."""
    return _HEADER.pack(
        SIGNATURE,
        VERSION,
        CODEC_H264,
        HEADER_SIZE,
        len(frame.data),
        WIDTH_PX,
        CODED_HEIGHT_PX,
        WIDTH_PX,
        HEIGHT_PX,
        frame_number & 0xFFFF_FFFF,
        timestamp_ms & 0xFFFF_FFFF,
        1,  # total_chuncks
        0,  # chunck_index
        IDR_FRAME if frame.is_idr else P_FRAME,
        0,  # control
        stream_byte_position & 0xFFFF_FFFF,
        stream_byte_position >> 32 & 0xFFFF_FFFF,
        1,  # stream_id
        1,  # total_slices
        0,  # slice_index
        frame.sps_size,
        frame.pps_size,
        0,  # advertised_size
    )


class VideoEncoder:
    """Encodes a stream of JPEG images as an AR.Drone 2.0 would. Needs av (PyAV)."""

    def __init__(self) -> None:
        import av

        codec: Any = av.CodecContext.create("libx264", "w")
        codec.width, codec.height, codec.pix_fmt = WIDTH_PX, HEIGHT_PX, "yuv420p"
        codec.time_base, codec.framerate = Fraction(1, RATE_HZ), Fraction(RATE_HZ)
        codec.bit_rate, codec.gop_size, codec.max_b_frames = BIT_RATE, IDR_INTERVAL, 0
        codec.thread_count = 1
        codec.options = PRESET
        self._codec = codec
        self._count = 0

    def encode(self, jpeg: bytes, force_idr: bool) -> VideoFrame | None:
        """Return the frame of a JPEG image, an IDR frame if `force_idr`; None if the encoder returns no data.

        Raises:
            VideoError: the data are not a readable JPEG.
        """
        import av
        from av.error import FFmpegError
        from av.video.frame import PictureType

        reader: Any = av.CodecContext.create("mjpeg", "r")
        try:
            pictures = reader.decode(av.Packet(jpeg))
        except (FFmpegError, ValueError) as error:
            raise VideoError(f"it is not a readable JPEG ({error})") from error
        if not pictures:
            raise VideoError("it is not a readable JPEG")
        picture = pictures[0].reformat(WIDTH_PX, HEIGHT_PX, "yuv420p")
        picture.pts, picture.time_base = self._count, self._codec.time_base
        picture.pict_type = PictureType.I if force_idr else PictureType.NONE
        self._count += 1
        data = b"".join(bytes(packet) for packet in self._codec.encode(picture))
        if not data:
            return None
        sizes = {kind: size for kind, size in nal_units(data) if kind in (IDR, SPS, PPS)}
        return VideoFrame(data, IDR in sizes, sizes.get(SPS, 0), sizes.get(PPS, 0))


def nal_units(data: bytes) -> Iterator[tuple[int, int]]:
    """Yield the type of each NAL unit, and its size including its start code (ITU-T H.264, annex B)."""
    starts = []
    position = data.find(b"\0\0\1")
    while position >= 0:
        starts.append((position - 1 if position and data[position - 1] == 0 else position, position + 3))
        position = data.find(b"\0\0\1", position + 3)
    ends = [start for start, _ in starts[1:]] + [len(data)]
    for (start, content), end in zip(starts, ends, strict=True):
        if content < len(data):
            yield data[content] & 0x1F, end - start
