"""The roles as processes, and how they are stopped. Imports arguments, and the packages that hold what they run."""
