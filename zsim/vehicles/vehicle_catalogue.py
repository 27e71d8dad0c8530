"""Vehicles by the name that a scenario gives: `ardrone2`, `crazyflie2`, or a module of the user's with a VEHICLE."""

import re
from functools import cache

import msgspec

from zsim.errors import DocumentError, NotTrustedError, reason_of
from zsim.schema import plugin
from zsim.schema.checker import faults, show
from zsim.vehicles import ardrone2, crazyflie2
from zsim.vehicles.vehicle import Vehicle

DEFAULT = "ardrone2"
STOCK: dict[str, Vehicle] = {"ardrone2": ardrone2.VEHICLE, "crazyflie2": crazyflie2.VEHICLE}
ALLOWED = f"{', '.join(STOCK)}, or package.module of your own that defines VEHICLE"
_MODULE = re.compile(r"[A-Za-z_]\w*(\.[A-Za-z_]\w*)*")


@cache
def vehicle_of(model: str, where: str = "model") -> Vehicle:
    """Return the vehicle of a model.

    Args:
        model: a stock name, or the `package.module` of one that defines VEHICLE.
        where: file and path of the field that names it.

    Raises:
        DocumentError: there is none, or its parameters are faulty; a line for each fault.
    """
    if model in STOCK:
        return STOCK[model]
    if not _MODULE.fullmatch(model):
        raise DocumentError([f"{where} is {show(model)}; must be one of {ALLOWED}"])
    try:
        plugin.load_module(model, where)
    except NotTrustedError:
        raise
    except DocumentError as error:
        reason = reason_of(error.__cause__) if error.__cause__ else "it cannot be found"
        raise DocumentError([f"{where} is {show(model)}; must be one of {ALLOWED} ({reason})"]) from error
    vehicle = plugin.load_object(model, where, "VEHICLE", Vehicle)
    flaws = [*faults(msgspec.to_builtins(vehicle), Vehicle)]
    if flaws:
        raise DocumentError([f"{where} is {show(model)}: VEHICLE.{path} {text}" for path, text in flaws])
    return vehicle
