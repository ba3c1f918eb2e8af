"""Model observers: retina, filters, internal noise, decision."""
