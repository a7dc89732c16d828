"""What people look at: recordings of flights, and what is made of them."""
