"""The roles as processes, and how these are stopped. Imports arguments, and the packages of what they run."""
