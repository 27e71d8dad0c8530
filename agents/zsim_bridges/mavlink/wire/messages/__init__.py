"""The messages of the dialect (common and ardupilotmega), as far as vehicles, ground stations and programs use them."""
