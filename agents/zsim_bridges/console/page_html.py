"""The page: viser's, with the cameras' windows below the scene; that of viewers shows its controls disabled."""

import gzip
import importlib.resources

VIEW_STYLE = (
    "<style>body::before{content:'view only';position:fixed;top:8px;left:50%;transform:translateX(-50%);z-index:9999;"
    "background:#1971c2;color:#fff;font:600 13px sans-serif;padding:3px 14px;border-radius:10px}"
    ".mantine-Button-root,.mantine-Slider-root,.mantine-Input-input{pointer-events:none;opacity:.4}</style>"
)


def operator_page() -> bytes:
    """Return the page of operators, compressed."""
    return _page("")


def viewer_page() -> bytes:
    """Return the page of viewers, compressed."""
    return _page(VIEW_STYLE)


def _page(style: str) -> bytes:
    html = importlib.resources.files("viser").joinpath("client/build/index.html").read_text()
    windows = importlib.resources.files("zsim_bridges.console.page").joinpath("camera_windows.html").read_text("utf-8")
    head, end, tail = html.rpartition("</body>")
    with_windows = f"{head}{windows}{end}{tail}" if end else f"{html}{windows}"
    return gzip.compress(with_windows.replace("</head>", f"{style}</head>", 1).encode())
