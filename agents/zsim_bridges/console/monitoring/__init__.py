"""What a console receives of a run, and what it makes of it: views, condition, figures of flight, alarms, events."""
