"""The pictures of the documentation, made by the product itself: ``make pictures``."""
