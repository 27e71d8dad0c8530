"""`zsim board` as a user runs it: a table and figures, a continued board, and the user's own law beside others."""

import csv
from pathlib import Path

import pytest
from forked_commands import refusal, run_here
from refused import has_terms

from zsim_analysis.board.board import MEASURES, board_of, fly_board
from zsim_analysis.board.board import BoardRequest as Request

OWN = """
from zsim_agents.laws.pilot import Pilot


class Hover(Pilot):
    def velocity(self, now):
        return 0.3 * (now.reference.p_W - now.p_W)
"""


def test_a_board_of_three_laws_is_flown_and_continued(
    near: None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "hovering.py").write_text(OWN)
    monkeypatch.syspath_prepend(str(tmp_path))
    laws, out = ["cluster_space", "consensus", "hovering:Hover"], tmp_path / "board"
    done = run_here("board", "--laws", ",".join(laws), "--scenarios", "drone_loss", "--seeds", "1", "-o", str(out))
    assert done.code == 0, done
    with (out / "board.csv").open() as file:
        rows = {row["law"]: row for row in csv.DictReader(file)}
    assert [*rows] == laws
    figures = {law: {each.name: float(row[each.name] or "nan") for each in MEASURES} for law, row in rows.items()}
    held, led = figures["cluster_space"], figures["consensus"]
    assert (
        held["centre_error_m"] > 4.0 > 1.0 > led["centre_error_m"]
    )  # cluster space holds when a drone is lost, consensus flies on
    assert held["shape_error_m"] < 0.6
    assert led["shape_error_m"] < 0.6
    assert led["messages_per_drone_s"] < 11 < held["messages_per_drone_s"]
    assert {each.name for each in (out / "figures").iterdir()} == {"measures.png", "paths.png", "shapes.png"}
    assert (out / "report.html").stat().st_size > 50_000
    assert "consensus" in (out / "board.md").read_text()

    request = Request(laws, ["drone_loss"], 1, out, workers=0)  # no flight is left for a worker
    again = board_of(request, fly_board(request))
    assert again.entry("drone_loss", "consensus").means["shape_error_m"] == pytest.approx(led["shape_error_m"])


@pytest.mark.parametrize(
    ("options", "terms"),
    [
        (("--laws", "consent"), ("--laws", "'consent'", "cluster_space", "consensus", "vasarhelyi")),
        (("--scenarios", "step,storm"), ("--scenarios", "'storm'", "corridor")),
        (("--laws", "nowhere:Law"), ("agents.pilot.class", "'nowhere:Law'")),
    ],
)
def test_unknown_laws_and_scenarios_are_refused(
    options: tuple[str, ...], terms: tuple[str, ...], tmp_path: Path
) -> None:
    assert has_terms(refusal("board", *options, "-o", str(tmp_path / "board")), *terms)


def test_a_folder_with_other_files_is_refused(tmp_path: Path) -> None:
    (tmp_path / "notes.txt").write_text("")
    assert has_terms(refusal("board", "--scenarios", "step", "-o", str(tmp_path)), "notes.txt", "--force")
