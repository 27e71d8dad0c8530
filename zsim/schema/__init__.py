"""Documents that people write: read with limits, checked against types, with modules of the user's. Imports errors."""
