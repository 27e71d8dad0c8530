"""One drone flown from a page, by hand or to a place, and the plan view from which that is done."""
