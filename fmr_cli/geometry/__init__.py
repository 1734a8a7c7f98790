"""What is true of points and poses whatever the method."""
