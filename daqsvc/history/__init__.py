"""What figures were over months, in one file on the box, and the alarm events beside them."""
