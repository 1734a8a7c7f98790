"""Local patch descriptors, their matching, and poses that many matches agree on."""
