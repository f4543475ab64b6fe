"""Parts of a scene beside its bodies: laws of contact, springs, joints, loads, sources."""
