"""The page's HTTP side: who may open it, what passes between browser and viser, its state as data."""
