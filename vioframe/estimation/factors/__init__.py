"""What optimisers share: one table of tracks, the factors between states and landmarks, and the solver over them."""
