"""What keeps the launcher out of a host is one line that says what to do."""

import asyncio
from pathlib import Path

import pytest
from lab import LAUNCHER, Lab
from namespaces import checked
from sshd import make_key

from zsim.errors import HostsError
from zsim_deploy.hosts import ssh_connection
from zsim_deploy.inventory import inventory
from zsim_deploy.inventory.inventory import Host


def refusal(lab: Lab, base: Path, host: Host) -> str:
    """Return what is said of a host that cannot be connected to."""
    with lab.inside(LAUNCHER), pytest.raises(HostsError) as caught:
        asyncio.run(ssh_connection.connect("h1", host, base))
    return str(caught.value)


def given(lab: Lab, **changed: str | int) -> Host:
    """Return a host of the lab with some of its fields changed."""
    told = {"address": lab.address("h1"), "user": "root", "key": "keys/client", "known_hosts": "keys/known_hosts"}
    return Host(**{**told, **changed})  # pyright: ignore[reportArgumentType]


def test_each_refusal_is_a_line(lab: Lab, tmp_path: Path) -> None:
    at = f"{lab.address('h1')} port 22"
    make_key(tmp_path / "other")
    checked(["ssh-keygen", "-q", "-t", "ed25519", "-N", "secret", "-f", str(tmp_path / "locked")])
    cases = {
        f"ssh at {at} refuses user root with key {tmp_path}/other; correct hosts.h1.user or key, or run ssh-copy-id":
            given(lab, key=str(tmp_path / "other")),
        f"key {tmp_path}/locked has a passphrase; add it to the agent with ssh-add and leave hosts.h1.key out":
            given(lab, key=str(tmp_path / "locked")),
        f"key {lab.folder}/keys/known_hosts is no private key (": given(lab, key="keys/known_hosts"),
        f"{lab.folder}/none cannot be read (No such file or directory); correct hosts.h1.key": given(lab, key="none"),
        f"{lab.folder}/keys cannot be read (Is a directory); correct hosts.h1.key": given(lab, key="keys"),
        f"the host key of {at} is not in {lab.folder}/keys/client.pub; check it and add it: ssh-keyscan -p 22 ":
            given(lab, known_hosts="keys/client.pub"),
        f"ssh at {lab.address('h1')} port 23 cannot be reached (Connection refused); is sshd on there, the port open?":
            given(lab, port=23),
        "address 'nowhere.invalid' is not known; correct hosts.h1.address or ssh":
            given(lab, address="nowhere.invalid"),
    }  # fmt: skip
    for wanted, host in cases.items():
        said = refusal(lab, lab.folder, host)
        assert said.startswith(f"h1: {wanted}")
        assert "\n" not in said


def test_a_host_that_does_not_answer_is_a_line(lab: Lab, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(ssh_connection, "CONNECT_S", 0.5)
    lab.cut("h1")
    assert refusal(lab, lab.folder, given(lab)) == (
        f"h1: ssh at {lab.address('h1')} port {inventory.SSH_PORT} did not answer within 0.5 s; "
        "is it on, is the address right, the port open?"
    )


@pytest.mark.parametrize("kind", ["ed25519", "rsa"])
def test_a_host_key_that_changed_is_not_called_unknown(lab: Lab, tmp_path: Path, kind: str) -> None:
    at, known = lab.address("h1"), tmp_path / "known_hosts"
    checked(["ssh-keygen", "-q", "-t", kind, "-N", "", "-C", "", "-f", str(tmp_path / "former")])
    known.write_text(f"{at} {(tmp_path / 'former.pub').read_text()}")
    said = refusal(lab, lab.folder, given(lab, known_hosts=str(known)))
    assert said.startswith(f"h1: the host key of {at} port 22 is not the one in {known} (it shows ")
    assert (
        f"another machine may pose as h1; ask who runs it, and only if the key was changed there, remove the old one (ssh-keygen -f {known} -R {at})"
        in said
    )
    assert "ssh-keyscan" not in said
    assert "\n" not in said
