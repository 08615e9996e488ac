"""An open benchmark: moving-projector scans with truth, and figures for the result of any method."""
