"""The version gives the commit of the code in a checkout, a worktree, a wheel, and an archive made by git."""

import re
import subprocess
import time
import tomllib
from pathlib import Path

import pytest

import zsim
from zsim.runtime.membership import Membership
from zsim.scenario import scenario_file
from zsim_world.run.world import World

ROOT = Path(__file__).parents[3]
WHO = ("-c", "user.name=me", "-c", "user.email=me@localhost", "-c", "init.defaultBranch=main")
OTHER = "0123456789abcdef0123456789abcdef01234567"


def git(folder: Path, *words: str) -> str:
    done = subprocess.run(["git", *WHO, "-C", str(folder), *words], check=True, capture_output=True, text=True)
    return done.stdout.strip()


def head(checkout: Path) -> str:
    return git(checkout, "rev-parse", "HEAD")


@pytest.fixture
def checkout(tmp_path: Path) -> Path:
    (tmp_path / "checkout" / "zsim").mkdir(parents=True)
    git(tmp_path / "checkout", "init", "-q")
    git(tmp_path / "checkout", "commit", "-q", "--allow-empty", "-m", "first")
    return tmp_path / "checkout"


def test_a_checkout_or_worktree_has_the_commit_of_its_branch_or_head(checkout: Path):
    first = head(checkout)
    assert zsim.commit(checkout / "zsim") == first
    git(checkout, "commit", "-q", "--allow-empty", "-m", "second")
    assert zsim.commit(checkout / "zsim") == head(checkout) != first
    worktree = checkout.parent / "worktree"
    git(checkout, "worktree", "add", "-q", "-b", "other", str(worktree))
    git(worktree, "commit", "-q", "--allow-empty", "-m", "third")
    assert zsim.commit(worktree / "zsim") == head(worktree) != head(checkout)
    git(checkout, "branch", "n/main")  # its name ends like that of the other branch
    git(checkout, "pack-refs", "--all")
    assert not (checkout / ".git" / "refs" / "heads" / "main").exists()
    assert zsim.commit(checkout / "zsim") == head(checkout)
    git(checkout, "checkout", "-q", "--detach")
    assert zsim.commit(checkout / "zsim") == head(checkout)


def test_a_build_has_its_commit_or_without_one_only_the_release(tmp_path: Path) -> None:
    (tmp_path / zsim.COMMIT_FILE).write_text(f"{OTHER}\n")
    assert zsim.commit(tmp_path) == OTHER
    (tmp_path / zsim.COMMIT_FILE).write_bytes((ROOT / "zsim" / zsim.COMMIT_FILE).read_bytes())
    assert zsim.commit(tmp_path) == ""


def test_an_archive_made_by_git_has_its_commit(checkout: Path) -> None:
    for name in (f"zsim/{zsim.COMMIT_FILE}", ".gitattributes"):
        (checkout / name).write_bytes((ROOT / name).read_bytes())
    git(checkout, "add", ".")
    git(checkout, "commit", "-q", "-m", "with the placeholder")
    git(checkout, "archive", "--output", "../archive.tar", "HEAD")
    (checkout.parent / "archive").mkdir()
    subprocess.run(["tar", "xf", "archive.tar", "-C", "archive"], cwd=checkout.parent, check=True)
    assert zsim.commit(checkout.parent / "archive" / "zsim") == head(checkout)


def test_world_and_participants_state_the_same_version() -> None:
    assert tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["version"] == zsim.RELEASE
    assert re.fullmatch(rf"{re.escape(zsim.RELEASE)}(\+g[0-9a-f]{{{zsim.DIGITS}}})?", zsim.__version__)
    scenario = scenario_file.load(ROOT / "scenarios" / "step.yaml")
    world = World(scenario, "lockstep", 0.0, time.monotonic_ns)
    assert (
        world.info().version
        == zsim.__version__
        == Membership("estimator.drone1", "here", "run", lambda kind: 0).join().version
    )
