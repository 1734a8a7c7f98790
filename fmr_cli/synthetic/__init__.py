"""Made-up shapes, scenes and scanners, with exact truth."""
