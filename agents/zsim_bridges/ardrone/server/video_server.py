"""The live video of a drone: a camera's pictures as H.264 frames behind PaVE headers, to who is connected."""

import asyncio
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import TYPE_CHECKING

from zsim.contract.flight_messages import CameraImage
from zsim_bridges.ardrone.server.addresses import AllowedHosts
from zsim_bridges.ardrone.server.stream_port import StreamPort, read_until_end
from zsim_bridges.ardrone.wire.pave import FrameType, PaveHeader

if TYPE_CHECKING:
    from zsim_bridges.ardrone.server.video_encoder import VideoEncoder, VideoFrame

BACKLOG_MAX = 500_000  # bytes that a connection may be behind, chosen: some seconds; then it waits for an IDR frame


class VideoServer:
    """Streams the pictures that it is given.

    Args:
        peers: who may connect.
        refuse: counts what cannot be streamed, with the reason.

    Attributes:
        port: to be opened.
    """

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
        """Whether somebody is connected."""
        return bool(self.port.writers)

    def close(self) -> None:
        """Encode no more."""
        if self._busy is not None:
            self._busy.cancel()
        self._thread.shutdown(wait=False, cancel_futures=True)

    async def _serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        try:
            await read_until_end(reader, writer)
        finally:
            self._ready.discard(writer)

    def on_picture(self, image: CameraImage) -> None:
        """Stream a picture; one that comes while another is encoded waits, and the next one takes its place."""
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
        """Return the picture as a frame, in the encoder's thread."""
        from zsim_bridges.ardrone.server.video_encoder import VideoEncoder

        self._encoder = self._encoder or VideoEncoder()
        return self._encoder.encode(image.data, begins)

    def _send(self, image: CameraImage, frame: "VideoFrame") -> None:
        kind = FrameType.IDR if frame.is_idr else FrameType.P
        header = PaveHeader(
            len(frame.data),
            self._frames,
            image.t_sample_ns // 1_000_000,
            kind,
            stream_byte_position=self._sent,
            sps_size=frame.sps_size,
            pps_size=frame.pps_size,
        )
        self._frames, self._sent = self._frames + 1, self._sent + len(frame.data)
        packet = header.pack() + frame.data
        for writer in tuple(self.port.writers):
            self._send_to(writer, packet, frame.is_idr)

    def _send_to(self, writer: asyncio.StreamWriter, packet: bytes, is_idr: bool) -> None:
        """Send a frame to one connection, if it can be decoded there and is wanted."""
        if writer.transport.get_write_buffer_size() > BACKLOG_MAX:
            self._ready.discard(writer)
        elif is_idr or writer in self._ready:
            self._ready.add(writer)
            writer.write(packet)
