"""A custom vehicle, `model: larger_battery`: the AR.Drone with the larger, 1500 mAh battery.

    PYTHONPATH=examples zsim run scenarios/step.yaml --set drones.drone1.model=larger_battery

It overrides a few parameters of a stock vehicle. A vehicle that differs more should start as a copy of
zsim/vehicles/crazyflie2.py.
"""

from msgspec.structs import replace

from zsim.vehicles.ardrone2 import VEHICLE as ARDRONE2

VEHICLE = replace(
    ARDRONE2,
    mass_kg=0.48,  # kg; weighed with this battery
    battery_mah=1500.0,  # mAh; printed on the battery
)
