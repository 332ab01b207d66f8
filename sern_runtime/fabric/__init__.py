"""Several relays as one: what carries datagrams and news between relays. Nothing here is imported without `fabric:`."""
