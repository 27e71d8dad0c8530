"""Number types of documents, with their limits, and physical constants."""

from typing import Annotated

from msgspec import Meta

# LARGE keeps squares and products of given numbers finite; it exceeds any quantity of a flight in SI units.
LARGE = 1e9
Real = Annotated[float, Meta(ge=-LARGE, le=LARGE)]
Positive = Annotated[float, Meta(gt=0, le=LARGE)]
NonNegative = Annotated[float, Meta(ge=0, le=LARGE)]
Fraction = Annotated[float, Meta(ge=0, le=1)]
Vector3 = tuple[Real, Real, Real]

G_M_S2 = 9.80665  # m/s^2, standard gravity, ISO 80000-3
SEA_LEVEL_KG_M3 = 1.225  # kg/m^3, density of the standard atmosphere at sea level and 15 deg C, ISO 2533
COULOMB_PER_MAH = 3.6  # C per mAh: 3600 s per hour
