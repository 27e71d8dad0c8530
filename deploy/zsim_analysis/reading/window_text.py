"""How times of a run, spans of it and shares of them are written, the same way in tables, pages and figures. Pure."""


def seconds_text(t_s: float) -> str:
    """Return a time [s] with two decimals at most."""
    return f"{t_s:.2f}".rstrip("0").rstrip(".")


def span_text(span_s: tuple[float, float]) -> str:
    """Return a span of time [s], with its unit."""
    return f"{seconds_text(span_s[0])} to {seconds_text(span_s[1])} s"


def percent_text(share: float) -> str:
    """Return a share in percent: less than all is never 100, more than nothing never 0."""
    percent = 100 * share if share in (0.0, 1.0) else min(max(100 * share, 0.1), 99.9)
    return f"{percent:.3g}"
