"""What a vehicle sends of itself, and how often. Pure."""
