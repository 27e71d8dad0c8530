"""What the operator's page consists of: the 3-D scene, the plots, and the forms that send requests. Imports viser."""
