"""Recordings in, `Flight` out: nothing downstream of this room knows what a bag is."""
