"""The numbers that typed documents hold, with their limits."""

from typing import Annotated

from msgspec import Meta

# LARGE keeps squares and products of what is given finite; it is beyond any quantity of a flight in SI units.
LARGE = 1e9
Real = Annotated[float, Meta(ge=-LARGE, le=LARGE)]
Positive = Annotated[float, Meta(gt=0, le=LARGE)]
NonNegative = Annotated[float, Meta(ge=0, le=LARGE)]
Fraction = Annotated[float, Meta(ge=0, le=1)]
Vector3 = tuple[Real, Real, Real]
