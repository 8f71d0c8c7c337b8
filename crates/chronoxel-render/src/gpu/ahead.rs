//! Payloads that are uploaded before they are drawn, so that the frame that needs them need not.

use chronoxel_codec::Payload;
use chronoxel_core::BrickLayout;

use super::bank::pack;
use super::portion::Residency;
use super::{GpuError, GpuRenderer};

impl GpuRenderer {
    /// Whether a payload lies on the GPU: drawing it uploads no indices and tables.
    ///
    /// * `key`: as that of a [`super::CodedBrick`]
    pub fn holds(&self, key: u64) -> bool {
        self.residency.holds(key)
    }

    /// Uploads a payload that a later picture may need. `None` where there is no room but that of the last picture's payloads, or no picture was
    /// drawn yet; else the bytes that it took.
    ///
    /// # Errors
    /// [`GpuError`] if the payload is not sound, or the device is lost.
    pub fn upload_ahead(
        &mut self,
        key: u64,
        payload: &Payload,
        layout: &BrickLayout,
    ) -> Result<Option<u64>, GpuError> {
        self.device.check()?;
        self.residency.upload_ahead(&self.device, key, payload, layout)
    }
}

impl Residency {
    fn holds(&self, key: u64) -> bool {
        self.here.as_ref().is_some_and(|here| here.banks.holds(key))
    }

    fn upload_ahead(
        &mut self,
        device: &super::device::Device,
        key: u64,
        payload: &Payload,
        layout: &BrickLayout,
    ) -> Result<Option<u64>, GpuError> {
        let Some(here) = self.here.as_mut().filter(|here| here.layout == *layout) else { return Ok(None) };
        if here.banks.holds(key) {
            return Ok(Some(0));
        }
        let packed = pack(payload, layout)?;
        loop {
            // As old as the last picture: newer than what it did not need, older than what the next one uses.
            if here.banks.put(device, key, &packed, self.now)?.is_some() {
                return Ok(Some(4 * packed.words.len() as u64));
            }
            if !here.banks.forget_oldest(self.began) {
                return Ok(None);
            }
        }
    }
}
