"""FMUs as agents: controllers and estimators exported from Simulink, Modelica tools and others, run with FMPy."""
