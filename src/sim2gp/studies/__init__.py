"""The figures of the paper and the mismatch map: cells, seeds, claims, a picture."""
