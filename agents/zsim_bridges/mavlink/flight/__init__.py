"""How a vehicle is flown: modes, targets, missions, fence; commands to its drone come out. Pure."""
