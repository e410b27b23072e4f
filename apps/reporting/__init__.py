"""What a run was given, did and reached: report.json, report.html and their pictures."""
