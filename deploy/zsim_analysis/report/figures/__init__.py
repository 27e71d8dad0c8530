"""The figures of a report and of a comparison, drawn with what `report.pages` gives all of them."""
