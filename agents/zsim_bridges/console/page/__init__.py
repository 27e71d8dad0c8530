"""The panels of the operator's page: plots, tables and the forms that send requests. Imports viser."""
