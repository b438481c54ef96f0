"""Networks that several of the compared systems are built on."""
