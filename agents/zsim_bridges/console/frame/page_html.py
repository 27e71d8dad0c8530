"""The page: viser's, below a head of its own, with tools over the scene and the cameras' windows.

Viewers see its controls disabled.
"""

import gzip
import importlib.resources

PARTS = (  # of the page beside viser's; of the last three, each uses those before it
    "head_bar.html",
    "camera_windows.html",
    "scene_tools.html",
    "flight_bar.html",
    "plan_drawing.html",
    "plan_view.html",
)
STYLE = "<style>div:has(> .uplot) {contain: inline-size}</style>"
"""A plot takes the width that its panel has: else the panel grows with its plots where no box around it may clip."""
VIEW_STYLE = (
    "<style>body::before{content:'view only';position:fixed;top:52px;left:50%;transform:translateX(-50%);z-index:9999;"
    "background:#1971c2;color:#fff;font:600 13px sans-serif;padding:3px 14px;border-radius:10px}"
    ".mantine-Button-root,.mantine-Slider-root,.mantine-Input-input{pointer-events:none;opacity:.4}</style>"
)


def operator_page() -> bytes:
    """Return the page of operators, compressed."""
    return _page(STYLE)


def viewer_page() -> bytes:
    """Return the page of viewers, compressed."""
    return _page(STYLE + VIEW_STYLE)


def _page(style: str) -> bytes:
    html = importlib.resources.files("viser").joinpath("client/build/index.html").read_text()
    folder = importlib.resources.files("zsim_bridges.console.frame")
    parts = "".join(folder.joinpath(name).read_text("utf-8") for name in PARTS)
    head, end, tail = html.rpartition("</body>")
    whole = f"{head}{parts}{end}{tail}" if end else f"{html}{parts}"
    return gzip.compress(whole.replace("</head>", f"{style}</head>", 1).encode())
