"""The live video: frames with PaVE headers that can be decoded from any IDR frame."""

import asyncio
import struct
from typing import NamedTuple

import pytest
import synthetic_pictures
from ardrone_readers import pyardrone_reads
from in_loop import in_loop

from zsim.contract.flight_messages import CameraImage
from zsim_bridges.ardrone import video
from zsim_bridges.ardrone.ardrone_server import AllowedHosts, VideoServer
from zsim_bridges.ardrone.video import (
    IDR_FRAME,
    IDR_INTERVAL,
    P_FRAME,
    VideoEncoder,
    VideoError,
    VideoFrame,
    nal_units,
    pave_header,
)

HOME = "127.0.0.1"
HEADER = pave_header(VideoFrame(bytes(1234), True, 14, 6), 7, 1500, (5 << 32) + 9)


def test_the_header_has_the_offsets_of_the_sdk_s_structure():
    assert len(HEADER) == 64
    assert HEADER[:4] == b"PaVE"
    assert struct.unpack_from("<HI4HII", HEADER, 6) == (64, 1234, 640, 368, 640, 360, 7, 1500)
    assert (HEADER[5], HEADER[30]) == (4, 1)
    assert struct.unpack_from("<II", HEADER, 32) == (9, 5)
    assert (HEADER[44], HEADER[45]) == (14, 6)


def test_pyardrone_reads_the_header():
    read = pyardrone_reads("video", HEADER)
    assert bytes(map(int, read["signature"])) == b"PaVE"
    expected = {"payload_size": 1234, "frame_number": 7, "frame_type": 1, "stream_byte_position_lw": 9}
    assert {name: read[name][0] for name in expected} == expected
    assert (read["header1_size"], read["header2_size"]) == ([14], [6])


av = pytest.importorskip("av")


def jpeg(shade: int) -> bytes:
    return synthetic_pictures.jpeg(shade, 320, 240)


def picture(shade: int, t_ms: int = 0, data: bytes | None = None) -> CameraImage:
    content = jpeg(shade) if data is None else data
    return CameraImage(
        t_ns=0, seq=0, t_sample_ns=t_ms * 1_000_000, source="camera", width=320, height=240, data=content
    )


def shades(frames: list[bytes]) -> list[float]:
    """Return the mean brightness of each frame as decoded by an independent H.264 decoder."""
    decoder = av.CodecContext.create("h264", "r")
    decoder.thread_count = 1
    decoded = [frame for data in (*frames, None) for frame in decoder.decode(av.Packet(data) if data else None)]
    assert {(frame.width, frame.height) for frame in decoded} <= {(640, 360)}
    return [float(frame.to_ndarray(format="gray").mean()) for frame in decoded]


def test_decoded_frames_have_the_brightness_of_the_pictures():
    encoder = VideoEncoder()
    frames = [encoder.encode(jpeg(shade), force_idr=False) for shade in (40, 120, 200)]
    assert [frame.is_idr for frame in frames if frame] == [True, False, False]
    brightness = shades([frame.data for frame in frames if frame])
    assert brightness[0] < brightness[1] < brightness[2]


def test_idr_frames_have_sps_and_pps_and_are_periodic_or_on_request():
    encoder = VideoEncoder()
    frames = [encoder.encode(jpeg(100), force_idr=k == 5) for k in range(IDR_INTERVAL + 6)]
    begins = [k for k, frame in enumerate(frames) if frame and frame.is_idr]
    assert begins == [0, 5, IDR_INTERVAL + 5]
    for frame in frames:
        assert frame is not None
        assert (frame.sps_size > 0, frame.pps_size > 0) == (frame.is_idr, frame.is_idr)
        assert sum(size for _, size in nal_units(frame.data)) == len(frame.data)


@pytest.mark.parametrize("data", [b"", b"\xff\xd8\xff", b"\xff\xd8\xff" + bytes(500)])
def test_an_unreadable_picture_is_refused(data: bytes):
    with pytest.raises(VideoError, match="readable JPEG"):
        VideoEncoder().encode(data, force_idr=False)


class Header(NamedTuple):
    """The fields of a header that the tests read."""

    frame_number: int
    timestamp_ms: int
    frame_type: int


class Stream:
    """A connection to a video server."""

    def __init__(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        self._reader = reader
        self.writer = writer

    async def frame(self) -> tuple[Header, bytes]:
        header = await self._reader.readexactly(video.HEADER_SIZE)
        size, *_, number, t_ms = struct.unpack_from("<I4HII", header, 8)
        return Header(number, t_ms, header[30]), await self._reader.readexactly(size)


class Served:
    """A video server on a loopback port."""

    def __init__(self) -> None:
        self.refusals: list[str] = []
        self.server = VideoServer(AllowedHosts("127.0.0.2", frozenset()), self.refusals.append)

    async def __aenter__(self) -> "Served":
        self._port = await self.server.port.open(HOME, 0)
        return self

    async def __aexit__(self, *_: object) -> None:
        self.server.close()
        await self.server.port.close()

    async def connect(self) -> Stream:
        before = len(self.server.port.writers)
        stream = Stream(*await asyncio.open_connection(HOME, self._port))
        while len(self.server.port.writers) == before:
            await asyncio.sleep(0)
        return stream


@in_loop
async def test_a_connection_begins_with_an_idr_frame() -> None:
    async with Served() as served:
        first = await served.connect()
        served.server.on_picture(picture(60, t_ms=100))
        header, data = await first.frame()
        assert (header.frame_type, header.timestamp_ms) == (IDR_FRAME, 100)
        served.server.on_picture(picture(80))
        assert (await first.frame())[0].frame_type == P_FRAME
        second = await served.connect()
        served.server.on_picture(picture(100))
        for stream in (first, second):
            header, data = await stream.frame()
            assert (header.frame_type, header.frame_number) == (IDR_FRAME, 2)
            assert shades([data])
            stream.writer.close()


@in_loop
async def test_nothing_is_encoded_without_a_connection() -> None:
    async with Served() as served:
        served.server.on_picture(picture(60))
        assert not served.server.is_watched
        stream = await served.connect()
        served.server.on_picture(picture(60))
        assert (await stream.frame())[0].frame_number == 0
        stream.writer.close()


@in_loop
async def test_an_unreadable_picture_is_counted_and_skipped() -> None:
    async with Served() as served:
        stream = await served.connect()
        served.server.on_picture(picture(0, data=b"\xff\xd8\xff" + bytes(100)))
        while not served.refusals:
            await asyncio.sleep(0)
        served.server.on_picture(picture(60))
        assert (await stream.frame())[0].frame_type == IDR_FRAME
        assert "picture" in served.refusals[0]
        stream.writer.close()
