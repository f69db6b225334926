"""Plans, controllers and filters under which the noisy system provably stays safe."""
