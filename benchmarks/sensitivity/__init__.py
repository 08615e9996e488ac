"""How the results depend on what is chosen or given: settings, gauge, starting poses, decoding, frames."""
