"""The cluster controller: phases, references, control law. Imports its spaces and zsim."""
