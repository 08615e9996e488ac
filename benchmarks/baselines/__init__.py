"""What others do, as a yardstick: fusion, rigid registration, window matching."""
