"""What a run is made of: who hears of it, what comes out, what a stage is given, how it fails."""
