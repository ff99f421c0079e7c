"""Turns the splats of a finished run into a closed mesh."""
