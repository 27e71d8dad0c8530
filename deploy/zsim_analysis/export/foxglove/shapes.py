"""Foxglove's messages out of plain numbers: times, poses, colours."""

from collections.abc import Sequence

from foxglove.messages import Color, Point3, Pose, Quaternion, Timestamp, Vector3

from zsim_analysis.export.columns import Values

LEVEL = Quaternion(x=0.0, y=0.0, z=0.0, w=1.0)
# Okabe and Ito's colours, told apart with every kind of colour vision.
DRONES = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9")
MAGENTA, DARK, GREY = "#d4008f", "#30363d", "#8c959f"


def timestamp(t_ns: int) -> Timestamp:
    return Timestamp(t_ns // 10**9, t_ns % 10**9)


def vector(v: Sequence[float] | Values) -> Vector3:
    x, y, z = map(float, v)
    return Vector3(x=x, y=y, z=z)


def point(v: Sequence[float] | Values) -> Point3:
    x, y, z = map(float, v)
    return Point3(x=x, y=y, z=z)


def quaternion(wxyz: Sequence[float] | Values) -> Quaternion:
    w, x, y, z = map(float, wxyz)
    return Quaternion(x=x, y=y, z=z, w=w)


def pose(position: Sequence[float] | Values, wxyz: Sequence[float] | Values | None = None) -> Pose:
    return Pose(position=vector(position), orientation=LEVEL if wxyz is None else quaternion(wxyz))


def rgb(text: str) -> tuple[float, float, float]:
    """Return red, green and blue, 0 to 1, of `#rrggbb`."""
    red, green, blue = (int(text[i : i + 2], 16) / 255 for i in (1, 3, 5))
    return red, green, blue


def colour(text: str, opacity: float = 1.0) -> Color:
    """Return a colour given as `#rrggbb`."""
    red, green, blue = rgb(text)
    return Color(r=red, g=green, b=blue, a=opacity)


def drone_colour(index: int) -> str:
    return DRONES[index % len(DRONES)]
