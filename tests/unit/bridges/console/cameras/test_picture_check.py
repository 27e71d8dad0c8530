"""What is let through to a browser as a picture."""

import io
from contextlib import suppress
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st
from refused import has_terms

from zsim.sensors.jpeg_header import PictureError, frame_of
from zsim_bridges.console.camera_feed import PICTURE_BYTES_MAX, check_picture

Image = pytest.importorskip("PIL.Image", reason="Pillow comes with viser; pip install '.[console]'")


def encoded(width: int = 40, height: int = 30, kind: str = "JPEG", **options: Any) -> bytes:
    out = io.BytesIO()
    Image.new("RGB", (width, height), (20, 90, 160)).save(out, kind, **options)
    return out.getvalue()


@pytest.mark.parametrize("options", [{}, {"progressive": True}, {"quality": 10}, {"comment": "x" * 3000}])
def test_the_size_of_a_jpeg_is_read(options: dict[str, Any]):
    assert frame_of(encoded(641, 363, **options))[1:] == (641, 363)


def test_fill_bytes_before_a_marker_are_passed_over():
    whole = encoded()
    assert frame_of(whole[:2] + b"\xff\xff" + whole[2:])[1:] == (40, 30)


@pytest.mark.parametrize(
    "data",
    [
        b"",
        b"\xff\xd8",
        b"\xff\xd8\xff\xd9",
        b"no picture",
        encoded(kind="PNG"),
        encoded()[:-40],
        encoded()[:30] + b"\xff\xd9",
    ],
)
def test_what_is_no_jpeg_is_refused(data: bytes):
    with pytest.raises(PictureError):
        check_picture(data, 40, 30)


@given(st.binary(max_size=200))
def test_any_bytes_have_a_size_or_are_refused(middle: bytes):
    with suppress(PictureError):
        assert all(0 < side < 2**16 for side in frame_of(b"\xff\xd8" + middle + b"\xff\xd9")[1:])


@given(at=st.integers(0, 600), byte=st.integers(0, 255))
def test_a_byte_that_is_wrong_does_no_harm(at: int, byte: int):
    data = bytearray(encoded())
    data[at % len(data)] = byte
    with suppress(PictureError):
        check_picture(bytes(data), 40, 30)


def test_the_message_and_the_picture_say_the_same_size():
    check_picture(encoded(), 40, 30)
    with pytest.raises(PictureError) as refusal:
        check_picture(encoded(), 30, 40)
    assert has_terms(str(refusal.value), "40 × 30", "30 × 40")


def test_a_picture_that_would_fill_a_browsers_memory_is_refused():
    data = encoded(4000, 4000)
    assert len(data) < PICTURE_BYTES_MAX
    with pytest.raises(PictureError) as refusal:
        check_picture(data, 4000, 4000)
    assert has_terms(str(refusal.value), "4000 × 4000", "2304000")


def test_too_many_bytes_are_refused():
    data = encoded()
    with pytest.raises(PictureError) as refusal:
        check_picture(data[:-2] + bytes(PICTURE_BYTES_MAX) + data[-2:], 40, 30)
    assert has_terms(str(refusal.value), str(PICTURE_BYTES_MAX))
