"""What judges records and flies many runs in one process: report, sweep, export, rerun. Imports zsim, world, agents."""
