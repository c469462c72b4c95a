#![allow(missing_docs)]
#[path = "/tmp/map/harness/src/lib.rs"]
mod harness;
use harness::*;
use kilogs::map_store::*;
use kilogs::mapping::*;
use kilogs::splat::cpu::*;
use kilogs::splat::*;
use kilogs_core::conventions::*;
use kilogs_core::frame::PixelFormat;
use kilogs_core::store::*;
use std::time::Instant;
fn env(name: &str, d: f64) -> f64 {
    std::env::var(name).ok().and_then(|v| v.parse().ok()).unwrap_or(d)
}
fn main() {
    let a: Vec<String> = std::env::args().collect();
    let d = load(&a[1], &a[2]);
    let out = &a[3];
    let n_kf: usize = a[4].parse().unwrap();
    let iters: u32 = a[5].parse().unwrap();
    let skip = env("SKIP", 0.) as usize;
    std::fs::create_dir_all(out).unwrap();
    let mut settings = MapperSettings::measured(1, env("RES", 0.5));
    settings.spawn.opacity = env("OPACITY", settings.spawn.opacity as f64) as f32;
    settings.spawn.max_stretch = env("STRETCH", settings.spawn.max_stretch);
    settings.spawn.flatness = env("FLAT", settings.spawn.flatness);
    settings.insertion.samples_per_pixel = env("SPP", settings.insertion.samples_per_pixel as f64) as f32;
    settings.insertion.bare_probability = env("BARE", settings.insertion.bare_probability as f64) as f32;
    settings.newest_share = env("NEWEST", settings.newest_share as f64) as f32;
    settings.older_share = env("OLDER", settings.older_share as f64) as f32;
    settings.min_confidence = env("CONF", settings.min_confidence as f64) as f32;
    settings.step.weights.isotropy = env("ISO", settings.step.weights.isotropy as f64) as f32;
    settings.step.weights.ssim = env("SSIM", settings.step.weights.ssim as f64) as f32;
    let r = &mut settings.step.rates;
    for (n, v) in [
        ("LR_OFF", &mut r.offset),
        ("LR_SCALE", &mut r.log_scale),
        ("LR_ROT", &mut r.rotation),
        ("LR_OP", &mut r.opacity),
        ("LR_COL", &mut r.color),
        ("LR_BG", &mut r.background),
    ] {
        let m = env(n, 1.0) as f32;
        v.start *= m;
        v.end *= m;
    }
    settings.step.progress = env("PROG", 0.0) as f32;
    let mut cap = MapperCapacity::KITTI;
    cap.gaussians_per_anchor = env("K", 4.) as usize;
    cap.anchors = env("ANCHORS", 65536.) as usize;
    cap.voxels = cap.anchors * 2;
    let cam_map = mapping_camera(&d.camera, settings.resolution);
    let backend = |w: u32, h: u32| {
        let mut c = Capacities::for_map(cap.anchors, cap.gaussians_per_anchor, w, h);
        c.keyframe_rows = cap.keyframe_rows;
        c.chunk_rows = cap.chunk_rows;
        c.pairs = 4_000_000;
        c.visible_gaussians = 196608;
        c.row_entries = 600_000;
        c.training_pixels = (cam_map.width * cam_map.height) as usize;
        println!("backend {} MiB", CpuBackend::memory_plan(&c).iter().map(|r| r.bytes()).sum::<usize>() >> 20);
        Box::new(CpuBackend::new(c, env("THREADS", 2.) as usize, SimdLevel::best(), |_| ()).unwrap())
    };
    let mut mapper = Mapper::new(settings, cap, &d.camera, 1, backend(d.camera.width, d.camera.height));
    println!("mapper {} MiB", cap.bytes(&cam_map, 1) >> 20);
    let manifest = Manifest {
        camera: d.camera,
        mounting: None,
        pixel_format: PixelFormat::Mono8,
        voxel_m: [0.1, 0.25, 1., 5., 25., 0., 0., 0.],
        n_levels: 5,
        gaussians_per_anchor: cap.gaussians_per_anchor as u32,
        counts: None,
        ..Manifest_default(d.camera)
    };
    let store = MapStoreWriter::create(
        std::path::Path::new(&format!("{out}/map")),
        &manifest,
        &StoreSettings {
            capacity: StoreCapacity { page_bytes: 3 << 20, page_buffers: 4, image_buffers: 2 },
            jpeg_quality: 85,
            when_busy: WhenBusy::Wait,
        },
    )
    .unwrap();
    let t0 = Instant::now();
    let (mut t_ins, mut t_opt) = (0.0, 0.0);
    let kfs: Vec<&Kf> = d.kfs.iter().skip(skip).take(n_kf).collect();
    for (o, kf) in kfs.iter().enumerate() {
        let img = gray(&d.dir, kf.frame);
        let packet = KeyframePacket {
            ordinal: o as u32,
            frame_index: kf.frame as u64,
            timestamp_ns: 0,
            world_from_camera: d.poses[kf.frame],
            image: MappingImage { pixels: &img, stride_bytes: d.camera.width as usize, format: PixelFormat::Mono8 },
            points: &kf.points,
            road: Some(ROAD),
        };
        let t = Instant::now();
        let rep = mapper.insert_keyframe(&packet, &mut &store).unwrap();
        t_ins += t.elapsed().as_secs_f64();
        let p = d.poses[kf.frame];
        store
            .place_keyframe(&StoredKeyframe {
                keyframe_id: o as u32,
                chunk_id: o as u32 / 100,
                frame_index: kf.frame as u64,
                timestamp_ns: 0,
                rotation_xyzw: quaternion_xyzw(&p.rotation),
                translation_m: p.translation.vector.into(),
                scale: 1.0,
                is_held_out: false,
                image_bytes: 0,
                image_crc: 0,
            })
            .unwrap();
        let t = Instant::now();
        let opt = mapper.optimize(iters);
        t_opt += t.elapsed().as_secs_f64();
        if o % 5 == 4 || o < 3 {
            println!(
                "{o} bare {:.3} samples {} anchors+{} gauss+{} occ {} ref {} | psnr {:.2} visible {} live {} pairs_ref {}",
                rep.mean_transmittance,
                rep.n_samples,
                rep.n_anchors,
                rep.n_gaussians,
                rep.n_occupied,
                rep.n_refused,
                opt.mean_psnr_db,
                opt.visible,
                mapper.n_resident_anchors(),
                opt.pairs_refused
            );
        }
    }
    mapper.finish(&mut &store);
    println!(
        "insert {t_ins:.1} s optimize {t_opt:.1} s total {:.1} {:?}",
        t0.elapsed().as_secs_f64(),
        mapper.counters()
    );
    drop(mapper);
    println!("{:?}", store.finish().unwrap());
    let reader = MapStoreReader::open(std::path::Path::new(&format!("{out}/map")), 10000).unwrap();
    let mut viewer = MapViewer::new(backend(d.camera.width, d.camera.height));
    let (w, h) = (d.camera.width as usize, d.camera.height as usize);
    let mut rgb = vec![[0f32; 3]; w * h];
    let radius = env("RADIUS", 120.);
    let mut psnr_of = |frame: usize, save: Option<String>| {
        let v = viewer.render(&reader, &d.poses[frame], &d.camera, radius, &mut rgb).unwrap();
        let img = gray(&d.dir, frame);
        let mse: f64 = rgb
            .iter()
            .zip(&img)
            .map(|(c, &g)| {
                let q = (c[0].clamp(0., 1.) * 255.).round() as f64 - g as f64;
                q * q
            })
            .sum::<f64>()
            / (w * h) as f64;
        if let Some(p) = save {
            let mut o = image::GrayImage::new(w as u32, 2 * h as u32);
            for y in 0..h {
                for x in 0..w {
                    o.put_pixel(x as u32, y as u32, image::Luma([img[y * w + x]]));
                    o.put_pixel(
                        x as u32,
                        (y + h) as u32,
                        image::Luma([(rgb[y * w + x][0].clamp(0., 1.) * 255.) as u8]),
                    );
                }
            }
            o.save(p).unwrap();
        }
        (10. * (255. * 255. / mse).log10(), v)
    };
    let t = Instant::now();
    let (mut sum, mut line, mut maxa, mut refd) = (0., String::new(), 0, 0);
    for (o, kf) in kfs.iter().enumerate() {
        let (p, v) = psnr_of(kf.frame, (o % 10 == 5).then(|| format!("{out}/r{o:03}.png")));
        sum += p;
        line += &format!("{p:.1} ");
        maxa = maxa.max(v.n_anchors);
        refd += v.n_refused + v.stats.overflow.pairs as usize;
    }
    println!("train: {line}");
    let last = kfs.last().unwrap().frame;
    let first = kfs[0].frame;
    let held: Vec<f64> = (first..last).filter(|f| f % 8 == 7).map(|f| psnr_of(f, None).0).collect();
    println!(
        "RESULT train {:.2} dB heldout {:.2} dB over {} / {} views, max anchors {maxa} refused {refd} view time {:.1}",
        sum / kfs.len() as f64,
        held.iter().sum::<f64>() / held.len().max(1) as f64,
        kfs.len(),
        held.len(),
        t.elapsed().as_secs_f64()
    );
}
#[allow(non_snake_case)]
fn Manifest_default(camera: kilogs_core::camera::Pinhole) -> Manifest {
    Manifest {
        camera,
        mounting: None,
        pixel_format: PixelFormat::Mono8,
        voxel_m: [0.; 8],
        n_levels: 5,
        gaussians_per_anchor: 4,
        counts: None,
    }
}
