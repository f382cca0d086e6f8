"""What predicted channels do to a link: rate adaptation, PUSCH and beams, with Sionna's PHY."""
