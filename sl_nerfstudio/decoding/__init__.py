"""From captured images to projector coordinates: coded grid by networks, Gray code by thresholds."""
