"""FMUs as agents: controllers, estimators and formations from Simulink, Modelica and others, by FMPy; docs/fmu.md."""
