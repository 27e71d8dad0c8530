"""JPEG of strangers: its size is read from its header, and nothing is decoded that is not as announced."""

import cv2
import numpy as np
import pytest
from refused import has_terms

from zsim.sensors.jpeg_header import PictureError, frame_of
from zsim_agents.cameras.detector import decoded

PICTURE = np.random.default_rng(1).integers(0, 255, (48, 64, 3), dtype=np.uint8)


def jpeg(*options: int) -> bytes:
    return cv2.imencode(".jpg", PICTURE, [*options])[1].tobytes()


@pytest.mark.parametrize(
    "options",
    [(), (cv2.IMWRITE_JPEG_PROGRESSIVE, 1), (cv2.IMWRITE_JPEG_RST_INTERVAL, 2), (cv2.IMWRITE_JPEG_QUALITY, 5)],
)
def test_the_size_of_any_jpeg_is_read(options: tuple[int, ...]) -> None:
    assert frame_of(jpeg(*options))[1:] == (64, 48)
    assert decoded(jpeg(*options), 64, 48).shape == (48, 64, 3)


@pytest.mark.parametrize(
    "data",
    [
        b"",
        b"\xff\xd8",
        b"\xff\xd8\xff\xd9",
        b"\xff\xd8\xff\xc0\x00",
        b"\xff\xd8\xff\xe0\x00\x00" * 9,
        b"\xff\xd8" + b"\xff" * 500,
        b"\x89PNG\r\n\x1a\n" + bytes(100),
        bytes(range(256)) * 4,
        cv2.imencode(".png", PICTURE)[1].tobytes(),
        jpeg()[:20],
    ],
)
def test_what_is_no_jpeg_is_refused(data: bytes) -> None:
    with pytest.raises(PictureError):
        decoded(data, 64, 48)


def test_every_cut_and_any_noise_is_taken_or_refused_in_a_line() -> None:
    data, rng = jpeg(), np.random.default_rng(2)
    for end in range(0, len(data), 37):
        try_decoding(data[:end])
    for _ in range(100):
        noisy = bytearray(data)
        for at in rng.integers(2, len(data), 5):
            noisy[at] = rng.integers(256)
        try_decoding(bytes(noisy))


def try_decoding(data: bytes) -> None:
    refusal = ""
    try:
        assert decoded(data, 64, 48).shape == (48, 64, 3)
    except PictureError as error:
        refusal = str(error)
    assert "\n" not in refusal


def test_a_header_of_an_absurd_size_is_refused_before_decoding(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(cv2, "imdecode", lambda *_: pytest.fail("was decoded"))
    data = bytearray(jpeg())
    at = data.index(b"\xff\xc0") + 5
    data[at : at + 4] = b"\xff\xff\xff\xff"
    with pytest.raises(PictureError) as caught:
        decoded(bytes(data), 64, 48)
    assert has_terms(str(caught.value), "65535", "64", "48")
    with pytest.raises(PictureError) as caught:
        decoded(bytes(data), 65535, 65535)
    assert has_terms(str(caught.value), str(65535**2))
