"""Several position sensors made into one position, with the faulty ones found and left out."""
