"""Everything after the last step of a run: evaluation, report, viewer, renders and videos."""
