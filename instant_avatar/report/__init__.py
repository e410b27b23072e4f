"""The report: report.json and report.html."""
