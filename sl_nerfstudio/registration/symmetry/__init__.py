"""Objects that look the same, or nearly, from several sides."""
