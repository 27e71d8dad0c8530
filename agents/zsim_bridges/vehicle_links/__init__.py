"""Parts shared by the bridges to the protocols of real aircraft."""
