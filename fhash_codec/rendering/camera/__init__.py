"""Cameras, poses and rays: where a picture is seen from."""
