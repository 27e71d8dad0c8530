"""The page: viser's, below a head of its own, with tools over the scene and the cameras' windows.

Viewers see its controls disabled.
"""

import gzip
import importlib.resources

PARTS = (  # of the page beside viser's; each part may use those before it
    "layout.html",
    "orders.html",
    "head_bar.html",
    "fleet_table.html",
    "camera_windows.html",
    "scene_tools.html",
    "flight_bar.html",
    "map_drawing.html",
    "map_view.html",
    "touch.html",
)
VIEW_STYLE = (
    "<style>.mantine-Button-root,.mantine-Slider-root,.mantine-Input-input,.zsim-order"
    "{pointer-events:none;opacity:.4}</style>"
)


def operator_page() -> bytes:
    """Return the page of operators, compressed."""
    return _page()


def viewer_page() -> bytes:
    """Return the page of viewers, compressed."""
    return _page(VIEW_STYLE)


def _page(style: str = "") -> bytes:
    html = importlib.resources.files("viser").joinpath("client/build/index.html").read_text()
    folder = importlib.resources.files("zsim_bridges.console.frame")
    parts = "".join(folder.joinpath(name).read_text("utf-8") for name in PARTS)
    head, end, tail = html.rpartition("</body>")
    whole = f"{head}{parts}{end}{tail}" if end else f"{html}{parts}"
    return gzip.compress(whole.replace("</head>", f"{style}</head>", 1).encode())
