"""`gsopt bench --suite`: many runs, their records and their tables."""
