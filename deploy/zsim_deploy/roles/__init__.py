"""The roles as processes, and how they are stopped. Imports options, and the packages that hold what they run."""
