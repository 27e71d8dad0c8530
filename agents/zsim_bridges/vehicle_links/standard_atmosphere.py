"""Heights from static pressure. Pure."""

P0_PA = 101_325.0  # Pa, at sea level (ISO 2533)
SCALE_M = 44_330.77  # m, T0 / lapse rate = 288.15 K / 6.5 K/km (ISO 2533)
EXPONENT = 0.190263  # R lapse / g (ISO 2533)


def pressure_altitude_m(pressure_pa: float) -> float:
    """Return the height above the sea at which the standard atmosphere has a pressure, below 11 km."""
    return SCALE_M * (1.0 - (max(pressure_pa, 0.0) / P0_PA) ** EXPONENT)


class FieldBarometer:
    """Height over the place where the first pressure was read, as an aircraft zeroes it at power-up."""

    def __init__(self) -> None:
        self._field_m: float | None = None

    def altitude_m(self, pressure_pa: float, height_m: float) -> float:
        """Return the height of a pressure.

        Args:
            pressure_pa: read now.
            height_m: where the aircraft is at the first reading, over the origin of W.
        """
        altitude_m = pressure_altitude_m(pressure_pa)
        if self._field_m is None:
            self._field_m = altitude_m - height_m
        return altitude_m - self._field_m
