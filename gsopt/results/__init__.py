"""Everything after the last step: evaluation, report, viewer, renders and videos."""
