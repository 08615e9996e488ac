"""Why a capture of the coded grid cannot be decoded: each cause is told only where it was measured."""
