"""From a signed distance field to a mesh in world units, cut to what was observed."""
