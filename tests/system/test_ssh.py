"""Every failed SSH connection to a host is reported in one line with a remedy."""

import asyncio
from pathlib import Path

import pytest
from lab import LAUNCHER, Lab
from namespaces import checked
from refused import has_terms
from sshd import make_key

from zsim.errors import HostsError
from zsim_deploy import inventory
from zsim_deploy.hosts import host_link
from zsim_deploy.inventory import Host


def refusal(lab: Lab, base: Path, host: Host) -> str:
    """Return the error for a host to which the launcher cannot connect."""
    with lab.inside(LAUNCHER), pytest.raises(HostsError) as caught:
        asyncio.run(host_link.connect("h1", host, base))
    return str(caught.value)


def given(lab: Lab, **changed: str | int) -> Host:
    """Return a host of the lab with some of its fields changed."""
    fields = {"address": lab.address("h1"), "user": "root", "key": "keys/client", "known_hosts": "keys/known_hosts"}
    return Host(**{**fields, **changed})  # pyright: ignore[reportArgumentType]


def test_each_refusal_is_reported_in_one_line(lab: Lab, tmp_path: Path) -> None:
    at = f"{lab.address('h1')} port 22"
    make_key(tmp_path / "other")
    checked(["ssh-keygen", "-q", "-t", "ed25519", "-N", "secret", "-f", str(tmp_path / "locked")])
    cases: list[tuple[Host, tuple[str, ...]]] = [
        (
            given(lab, key=str(tmp_path / "other")),
            (at, "user root", f"{tmp_path}/other", "hosts.h1.user", "ssh-copy-id"),
        ),
        (given(lab, key=str(tmp_path / "locked")), (f"{tmp_path}/locked", "passphrase", "ssh-add", "hosts.h1.key")),
        (given(lab, key="keys/known_hosts"), (f"{lab.folder}/keys/known_hosts",)),
        (given(lab, key="none"), (f"{lab.folder}/none", "No such file", "hosts.h1.key")),
        (given(lab, key="keys"), (f"{lab.folder}/keys", "Is a directory", "hosts.h1.key")),
        (given(lab, known_hosts="keys/client.pub"), (at, f"{lab.folder}/keys/client.pub", "ssh-keyscan -p 22 ")),
        (given(lab, port=23), (f"{lab.address('h1')} port 23", "Connection refused")),
        (given(lab, address="nowhere.invalid"), ("'nowhere.invalid'", "hosts.h1.address")),
    ]
    for host, tokens in cases:
        line = refusal(lab, lab.folder, host)
        assert line.startswith("h1: ")
        assert has_terms(line, *tokens), line
        assert "\n" not in line


def test_a_host_that_does_not_answer_is_reported(lab: Lab, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(host_link, "CONNECT_S", 0.5)
    lab.cut("h1")
    line = refusal(lab, lab.folder, given(lab))
    assert has_terms(line, "h1: ", f"{lab.address('h1')} port {inventory.SSH_PORT}", "0.5 s")


@pytest.mark.parametrize("kind", ["ed25519", "rsa"])
def test_a_changed_host_key_is_not_reported_as_unknown(lab: Lab, tmp_path: Path, kind: str) -> None:
    at, known = lab.address("h1"), tmp_path / "known_hosts"
    checked(["ssh-keygen", "-q", "-t", kind, "-N", "", "-C", "", "-f", str(tmp_path / "former")])
    known.write_text(f"{at} {(tmp_path / 'former.pub').read_text()}")
    output = refusal(lab, lab.folder, given(lab, known_hosts=str(known)))
    assert has_terms(output, "h1: ", f"{at} port 22", str(known), f"ssh-keygen -f {known} -R {at}")
    assert "ssh-keyscan" not in output
    assert "\n" not in output
