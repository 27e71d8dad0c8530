"""The report of a sweep: tables, figures and page of its runs. Imports points and zsim_analysis.report."""
