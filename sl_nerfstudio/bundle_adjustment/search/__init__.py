"""The search for the poses with the smallest residuals: stages, lost frames, further searches after rough starts."""
