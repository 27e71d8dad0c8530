"""A router with access control knows which processes behind it must lose no data, despite its own few rights."""

import time
from pathlib import Path
from threading import Event

import pytest
from rights_table import SCENARIO
from secured import SITE, Certificates, hub, tls_endpoint
from wire import PATIENCE_S

from zsim.contract import keys
from zsim.contract.run_messages import Join
from zsim.scenario import scenario_file
from zsim.transport import connection
from zsim.transport.link_watch import Awaited
from zsim_deploy.certificates import access_control
from zsim_deploy.roles.roles import RouterLinks

ESTIMATOR, GATE_NS = "estimator.drone1", 20_000_000


@pytest.mark.parametrize("joins", [True, False])
def test_a_router_knows_participants_behind_it_by_token_and_join(tmp_path: Path, joins: bool) -> None:
    made = Certificates(tmp_path)
    rules = access_control(scenario_file.from_text(SCENARIO), [ESTIMATOR], {}, ["world"])
    there, wanted = tls_endpoint(), [Awaited((ESTIMATOR,), 7 if joins else 0)]
    with (
        hub(made, (), [ESTIMATOR]) as (endpoint, _),
        connection.route(there, endpoint, "zsim", "lockstep", made.identity(SITE, rules)) as router,
        connection.connect(there, "zsim", wait_s=PATIENCE_S, identity=made.identity(ESTIMATOR)) as link,
    ):
        links = RouterLinks(router, print)
        link.declare_process(ESTIMATOR)
        until_s = time.monotonic() + PATIENCE_S
        while links.awaited() != wanted:
            assert time.monotonic() < until_s, links.awaited()
            if joins:  # repeated until the router's subscription exists
                link.put(keys.process(ESTIMATOR, "join"), Join(0, 0, "r", 1, "estimator", "lab", 7, GATE_NS))
            Event().wait(0.05)  # nothing signals the arrival of a token
