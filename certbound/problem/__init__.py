"""What is asked: a system with noise, where it starts, what it must respect, and the files that say so."""
