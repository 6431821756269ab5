"""The Laval rotor with rub impact: its model, its observers, and the bank that compares them."""
