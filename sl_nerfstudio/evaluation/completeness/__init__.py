"""What a scan lacks: where its surface ends, and the capture that would show most of what is missing."""
