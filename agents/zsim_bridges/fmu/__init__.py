"""FMUs as agents: controllers of drones and formations, and estimators, from Simulink, Modelica and others, by FMPy."""
