"""Heights from static pressure. Pure."""

P0_PA = 101_325.0  # Pa, at sea level (ISO 2533)
SCALE_M = 44_330.77  # m, T0 / lapse rate = 288.15 K / 6.5 K/km (ISO 2533)
READINGS = 250  # chosen: 10 s at 25 Hz make of 0.1 m of noise less than 1 cm
EXPONENT = 0.190263  # R lapse / g (ISO 2533)


def pressure_altitude_m(pressure_pa: float) -> float:
    """Return the height above the sea at which the standard atmosphere has a pressure, below 11 km."""
    return SCALE_M * (1.0 - (max(pressure_pa, 0.0) / P0_PA) ** EXPONENT)


class FieldBarometer:
    """Heights over the origin of W from pressure, as far as the first readings tell how the air lies there."""

    def __init__(self) -> None:
        self._offset_m = 0.0
        self._readings = 0

    def altitude_m(self, pressure_pa: float, height_m: float) -> float:
        """Return the height of a pressure.

        Args:
            pressure_pa: read now.
            height_m: where the aircraft believes to be, over the origin of W; used for the first readings alone.
        """
        altitude_m = pressure_altitude_m(pressure_pa)
        if self._readings < READINGS:
            self._readings += 1
            self._offset_m += (altitude_m - height_m - self._offset_m) / self._readings
        return altitude_m - self._offset_m
