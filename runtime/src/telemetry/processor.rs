//! What the processor calls itself.

/// Name of the processor, where the system tells it.
pub fn processor_name() -> Option<String> {
    name_in(&std::fs::read_to_string("/proc/cpuinfo").ok()?)
}

fn name_in(cpuinfo: &str) -> Option<String> {
    let line = cpuinfo.lines().find_map(|line| line.strip_prefix("model name"))?;
    let (_, name) = line.split_once(':')?;
    Some(name.trim().to_owned())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_first_processor_is_named_and_a_silent_system_is_not() {
        let told = "processor\t: 0\nmodel name\t: A Fast One @ 3 GHz\nprocessor\t: 1\nmodel name\t: Another\n";
        assert_eq!(name_in(told).as_deref(), Some("A Fast One @ 3 GHz"));
        assert_eq!(name_in("processor\t: 0\n"), None);
    }
}
