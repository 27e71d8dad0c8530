"""The live video of a drone: a camera's pictures as H.264 frames behind PaVE headers, to everybody connected.

PaVE is Parrot's video encapsulation, on TCP port 5555. Source: ARDroneLib (SDK 2.0.1), video_encapsulation.h.
"""

import asyncio
import struct
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from fractions import Fraction
from typing import Any, NamedTuple

from zsim.contract.flight_messages import CameraImage
from zsim_bridges.ardrone.ports import AllowedHosts, StreamPort, read_until_end

PORT = 5555  # TCP (ARDroneLib, config.h)
SIGNATURE = b"PaVE"
VERSION = 2
CODEC_H264 = 4
HEADER_SIZE = 64  # bytes that have a meaning; later firmware adds four more
WIDTH_PX, HEIGHT_PX, CODED_HEIGHT_PX = 640, 360, 368  # as displayed; coded in whole macroblocks
RATE_HZ = 30  # frames a second, for the encoder's rate control
IDR_EVERY = 30  # frames, chosen: after a loss, decoding begins again within a second
BIT_RATE = 1_000_000  # bit/s: video:bitrate of the SDK, 1000 kbit/s
IDR_FRAME, P_FRAME = 1, 3  # of a header; an IDR frame has SPS and PPS before it
IDR, SPS, PPS = 5, 7, 8  # types of NAL units (ITU-T H.264, table 7-1)
PRESET = {"preset": "ultrafast", "tune": "zerolatency", "profile": "baseline", "x264-params": "annexb=1"}
BACKLOG_MAX = 500_000  # chosen; backlog of a connection in bytes, some seconds; beyond it it waits for an IDR frame
_HEADER = struct.Struct("<4sBBHIHHHHIIBBBBIIHBBBB2xI12x")


class VideoServer:
    """Streams the pictures of one drone on its `port`, which is to be opened."""

    def __init__(self, peers: AllowedHosts, refuse: Callable[[str], None]) -> None:
        self._refuse = refuse
        self.port = StreamPort(peers, self._serve, refuse)
        self._ready: set[asyncio.StreamWriter] = set()  # have had an IDR frame, and all since
        self._newest: CameraImage | None = None
        self._busy: asyncio.Task[None] | None = None
        self._encoder: VideoEncoder | None = None
        self._thread = ThreadPoolExecutor(1, thread_name_prefix="video")
        self._frames = self._sent = 0

    @property
    def is_watched(self) -> bool:
        return bool(self.port.writers)

    def close(self) -> None:
        if self._busy is not None:
            self._busy.cancel()
        self._thread.shutdown(wait=False, cancel_futures=True)

    async def _serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        try:
            await read_until_end(reader, writer)
        finally:
            self._ready.discard(writer)

    def on_picture(self, image: CameraImage) -> None:
        """Stream a picture; while another is encoded, only the newest waits."""
        self._newest = image
        if self.is_watched and self._busy is None:
            self._busy = asyncio.get_running_loop().create_task(self._stream())

    async def _stream(self) -> None:
        loop = asyncio.get_running_loop()
        try:
            while self._newest is not None and self.is_watched:
                image, self._newest = self._newest, None
                begins = any(writer not in self._ready for writer in self.port.writers)
                try:
                    frame = await loop.run_in_executor(self._thread, self._encode, image, begins)
                except ValueError as error:
                    self._refuse(f"a picture cannot be streamed: {error}")
                    continue
                if frame is not None:
                    self._send(image, frame)
        finally:
            self._busy = None

    def _encode(self, image: CameraImage, begins: bool) -> "VideoFrame | None":
        self._encoder = self._encoder or VideoEncoder()
        return self._encoder.encode(image.data, begins)

    def _send(self, image: CameraImage, frame: "VideoFrame") -> None:
        """Send a frame to every connection that can decode it and keeps up."""
        packet = pave_header(frame, self._frames, image.t_sample_ns // 1_000_000, self._sent) + frame.data
        self._frames, self._sent = self._frames + 1, self._sent + len(frame.data)
        for writer in tuple(self.port.writers):
            if writer.transport.get_write_buffer_size() > BACKLOG_MAX:
                self._ready.discard(writer)
            elif frame.is_idr or writer in self._ready:
                self._ready.add(writer)
                writer.write(packet)


class VideoError(ValueError):
    """A picture cannot be read."""


class VideoFrame(NamedTuple):
    """The NAL units of a picture, with start codes.

    Attributes:
        is_idr: whether decoding can begin here; then it contains SPS and PPS.
        sps_size, pps_size: bytes of these, start codes included; 0 without them.
    """

    data: bytes
    is_idr: bool
    sps_size: int
    pps_size: int


def pave_header(frame: VideoFrame, frame_number: int, timestamp_ms: int, stream_byte_position: int) -> bytes:
    """Return the header of a frame; its position in the stream counts the bytes of the frames before."""
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
    """Encodes one stream of JPEG pictures as an AR.Drone 2.0 does. Needs av (PyAV)."""

    def __init__(self) -> None:
        import av

        codec: Any = av.CodecContext.create("libx264", "w")
        codec.width, codec.height, codec.pix_fmt = WIDTH_PX, HEIGHT_PX, "yuv420p"
        codec.time_base, codec.framerate = Fraction(1, RATE_HZ), Fraction(RATE_HZ)
        codec.bit_rate, codec.gop_size, codec.max_b_frames = BIT_RATE, IDR_EVERY, 0
        codec.thread_count = 1
        codec.options = PRESET
        self._codec = codec
        self._count = 0

    def encode(self, jpeg: bytes, begins: bool) -> VideoFrame | None:
        """Return the frame of a JPEG picture; `begins`: decoding must be able to begin here.

        Raises:
            VideoError: it is not a readable JPEG.
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
        picture.pict_type = PictureType.I if begins else PictureType.NONE
        self._count += 1
        data = b"".join(bytes(packet) for packet in self._codec.encode(picture))
        if not data:
            return None
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
