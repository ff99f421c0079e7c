"""`gsopt train-many`: one run per scene of a folder or a manifest, on a farm, with one page about all of them."""
