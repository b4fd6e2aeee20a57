"""What a run is: its configuration, its folder, its metrics, its pictures."""
