"""Steering of the run's time, and of drones one by one or all together."""

import viser

from zsim.contract.messages import GATES_MAX, RATE_MAX
from zsim.scenario.scenario import Scenario
from zsim_bridges.console.command_client import Desk

PINNED = """<style>
.mantine-ScrollArea-content div:has(.icon-tabler-alert-octagon) {overflow: visible !important}
div:has(> button .icon-tabler-alert-octagon) {position: sticky; top: 0; z-index: 10}
</style>"""  # the button of that icon is seen however far a page is scrolled: no box around it may clip
FLEET = {"Take off all": "takeoff", "Land all": "land"}  # an operation of a formation, and a mode of a drone


class RunForm:
    """Pause, go on, single steps, rate.

    Args:
        gui: viser's, in the place where they are to be.
        desk: sends what is asked for.
        rate: that the run was started with.
    """

    def __init__(self, gui: viser.GuiApi, desk: Desk, rate: float) -> None:
        gui.add_button("Pause", icon=viser.Icon.PLAYER_PAUSE).on_click(lambda _: desk.world("pause"))
        gui.add_button("Resume", icon=viser.Icon.PLAYER_PLAY).on_click(lambda _: desk.world("resume"))
        gates = gui.add_number("gates", 1, min=1, max=GATES_MAX, step=1)
        step = gui.add_button("Step", icon=viser.Icon.PLAYER_TRACK_NEXT)
        step.on_click(lambda _: desk.world("step", gates=int(gates.value)))
        wanted = gui.add_number(
            "rate", rate, min=0.0, max=RATE_MAX, step=0.5, hint="Real time is 1; 0: as fast as it goes"
        )
        gui.add_button("Set rate").on_click(lambda _: desk.world("rate", value=float(wanted.value)))


class FleetForm:
    """Emergency, take-off and landing of all drones.

    Formations take off and land by their controllers, drones of none each by itself.

    Args:
        gui: viser's, in the place where they are to be.
        desk: sends what is asked for.
        scenario: names the drones and formations.
    """

    def __init__(self, gui: viser.GuiApi, desk: Desk, scenario: Scenario) -> None:
        self._desk = desk
        self._formations = [cluster.name for cluster in scenario.clusters]
        in_formation = {name for cluster in scenario.clusters for name in cluster.drones}
        everybody = [drone.name for drone in scenario.drones]
        self._single = [name for name in everybody if name not in in_formation]
        stop = gui.add_button("EMERGENCY – all rotors stop", color="red", icon=viser.Icon.ALERT_OCTAGON)
        stop.on_click(lambda _: desk.mode(everybody, "emergency"))
        gui.add_html(PINNED)
        both = gui.add_button_group("all drones", list(FLEET))
        both.on_click(lambda _: self._ask(FLEET[both.value]))

    def _ask(self, what: str) -> None:
        for name in self._formations:
            self._desk.cluster(name, what)
        if self._single:
            self._desk.mode(self._single, what)


class DroneForm:
    """Take-off, landing and emergency of one drone.

    Args:
        gui: viser's, in the place where they are to be.
        desk: sends what is asked for.
        scenario: names the drones.
    """

    def __init__(self, gui: viser.GuiApi, desk: Desk, scenario: Scenario) -> None:
        names = [drone.name for drone in scenario.drones]
        self._chosen = gui.add_dropdown("drone", names)
        for label, mode, icon in (
            ("Take off drone", "takeoff", viser.Icon.PLANE_DEPARTURE),
            ("Land drone", "land", viser.Icon.PLANE_ARRIVAL),
            ("Emergency drone", "emergency", viser.Icon.ALERT_TRIANGLE),
            ("Reset drone", "reset", viser.Icon.REFRESH),
        ):
            colour = "red" if mode == "emergency" else "gray"
            button = gui.add_button(label, icon=icon, color=colour)
            button.on_click(lambda _, mode=mode: desk.mode([self._chosen.value], mode))

    @property
    def chosen(self) -> str:
        """Name of the drone that is chosen."""
        return self._chosen.value
