"""`gsopt train --cells`: a coarse run of a big scene, a run per cell beside the frozen rest, crop, merge and polish."""
